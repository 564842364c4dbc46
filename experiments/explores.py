"""The earlier name of `seed_table`, for command lines that were written down."""

from .seed_table import main
from .system.process import run_script

if __name__ == "__main__":
    run_script(main)
