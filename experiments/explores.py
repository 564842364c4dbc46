"""The earlier name of `seed_table`, kept for existing command lines."""

from .seed_table import main
from .system.process import run_script

if __name__ == "__main__":
    run_script(main)
