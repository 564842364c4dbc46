"""Studies of trained modules: feature spaces, novelty along a trajectory, fixed rollouts.

Contains the studies of section 5.4 of the thesis, the recorded trajectory that they use, and the
replay of updates that produced NaN or Inf. Must not import sweeps or benchmarks.
"""
