"""What is made of finished runs: curves, tables, statistics over seeds, one self-contained page.

Reads run directories and writes pictures, CSV files and pages. Imports no jax: it knows nothing of
agents or training.
"""
