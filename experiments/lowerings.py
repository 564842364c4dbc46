"""The earlier name of `convolutions`, kept for existing command lines."""

from .convolutions import main
from .system.process import run_script

if __name__ == "__main__":
    run_script(main)
