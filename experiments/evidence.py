"""The earlier name of `gpu_suite`, kept for existing command lines."""

from .gpu_suite import main
from .system.process import run_script

if __name__ == "__main__":
    run_script(main)
