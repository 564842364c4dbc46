"""The earlier name of `compiled_cost`, kept for existing command lines."""

from .compiled_cost import main
from .system.process import run_script

if __name__ == "__main__":
    run_script(main)
