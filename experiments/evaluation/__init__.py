"""Evaluation of trained agents: loading from a run, metrics of whole episodes, films.

Must not depend on training beyond the checkpoints that it reads and the agents that it builds.
"""
