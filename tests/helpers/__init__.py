"""What several test files use: random rollouts, run directories made by hand, child processes."""
