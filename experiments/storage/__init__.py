"""A run directory and what is in it: configuration, logs, checkpoints, trackers; reading them back.

What is written survives a kill at any moment. Knows nothing of agents: a state is a tree of arrays.
"""
