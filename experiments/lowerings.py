"""The earlier name of `convolutions`, for command lines that were written down."""

from .convolutions import main
from .system.process import run_script

if __name__ == "__main__":
    run_script(main)
