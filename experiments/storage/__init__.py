"""A run directory: writing and reading its configuration, logs, checkpoints and trackers.

Written data survives a kill of the process at any moment. Knows nothing of agents: a state is a
tree of arrays.
"""
