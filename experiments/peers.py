"""The earlier name of `external`, for command lines that were written down."""

from .external import main
from .system.process import run_script

if __name__ == "__main__":
    run_script(main)
