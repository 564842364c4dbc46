"""Training of the agents of a configuration: environments -> rollout -> train_step -> log.

Start at `trainer.py`; `experiment.py` builds the objects that it needs. Must not depend on reports,
sweeps or benchmarks.
"""
