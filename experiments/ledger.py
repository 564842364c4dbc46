"""The earlier name of `compiled_cost`, for command lines that were written down."""

from .compiled_cost import main
from .system.process import run_script

if __name__ == "__main__":
    run_script(main)
