"""Helpers of several test files: random rollouts, run directories made by hand, processes."""
