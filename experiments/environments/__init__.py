"""The environments of a run, stepped together, and the readers of their observations.

A pool holds the environments of all seeds of one task, from envpool or from gymnasium, and returns
arrays [S, N, ...]. Knows nothing of agents, run directories or logs.
"""
