"""The earlier name of `random_agent`, for command lines that were written down."""

from .random_agent import main
from .system.process import run_script

if __name__ == "__main__":
    run_script(main)
