"""Reports of runs: curves, tables, statistics over seeds, one self-contained HTML page.

Reads run directories and writes pictures, CSV files and pages. Imports no jax, and must not depend
on agents or training.
"""
