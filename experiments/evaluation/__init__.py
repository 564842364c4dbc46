"""Trained agents read back from their runs: how well they play, and films of it.

Knows nothing of training beyond the checkpoint that it reads.
"""
