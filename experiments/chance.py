"""The earlier name of `random_agent`, kept for existing command lines."""

from .random_agent import main
from .system.process import run_script

if __name__ == "__main__":
    run_script(main)
