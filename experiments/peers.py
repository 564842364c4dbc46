"""The earlier name of `external`, kept for existing command lines."""

from .external import main
from .system.process import run_script

if __name__ == "__main__":
    run_script(main)
