"""The configuration: from a command line to a validated `Config`, without importing jax.

Holds every option with its type, default, range and meaning, the command lines of the tools, and
the reading of stored configurations. Knows nothing of run directories, agents or training.
Only `envpool_tasks` imports envpool.
"""
