"""What trained modules have learned: feature spaces, novelty along a trajectory, fixed rollouts.

Studies of section 5.4 of the thesis, the recorded trajectory that they use, and updates that are
run once more to see what went wrong. Knows nothing of sweeps or benchmarks.
"""
