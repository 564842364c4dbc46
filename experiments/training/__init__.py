"""From a configuration to a trained agent: environments -> rollout -> train_step -> log.

Start at `trainer.py`; `experiment.py` builds what it needs. Knows nothing of reports, sweeps or
benchmarks.
"""
