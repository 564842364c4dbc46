"""The trial: does a self-supervised encoder beat the random one (docs/results/trial.md)?

Its tasks, methods and statistic are data (`data/trial.yaml`), which was committed before the first
row ran. This room tunes every method, runs the seeds and writes the page; it trains nothing in a
way of its own.
"""
