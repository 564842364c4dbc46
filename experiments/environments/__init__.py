"""The environments of a run, stepped together, and how their observations are read.

A pool holds the environments of all seeds of one task, of envpool or of gymnasium, and gives arrays
[S, N, ...]. Knows nothing of agents, run directories or logs.
"""
