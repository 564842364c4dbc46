"""Build experiments that cannot fit."""

import pytest

from experiments.config.compose import load_config
from experiments.system.errors import ConfigError
from experiments.training import experiment
from experiments.training.experiment import build_experiment

CAR = ["env=MountainCar", "algo=ppo", "num_envs=8", "rollout_length=15", "ppo.minibatch_size=40"]


def test_build_experiment_rollout_larger_than_the_memory_is_refused(monkeypatch):
    """16 x 8 observations of two float32 numbers are 1,024 bytes."""
    monkeypatch.setattr(experiment, "available_memory", lambda: 1024)
    build_experiment(load_config(CAR))
    monkeypatch.setattr(experiment, "available_memory", lambda: 1023)
    with pytest.raises(
        ConfigError, match=r"num_envs=8 x rollout_length=15 of shape \(2,\), take 0 GB"
    ):
        build_experiment(load_config(CAR))
    build_experiment(load_config(CAR), probe=True)  # plays elsewhere
