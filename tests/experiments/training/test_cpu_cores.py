"""Which agents are placed on the cores of a CPU, one device each."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from experiments.config.compose import load_config
from experiments.training.cpu_cores import CpuCores, place_on_cores
from experiments.training.placement import SINGLE_DEVICE

POOL = SimpleNamespace(shape=(8,), dtype=np.float32, num_actions=3, unbounded=())


@pytest.mark.parametrize(
    ("options", "divided"),
    [
        ([], True),
        (["network.hidden=[128,128]"], True),
        (["network=wide"], False),
        (["network.policy.hidden=[512]"], False),
        (["network.module.features=512"], False),
        (["network=wide", "num_seeds=2"], True),  # seeds exchange nothing
    ],
)
def test_place_on_cores_wide_networks_of_one_agent_stay_on_one_device(
    options, divided, monkeypatch
):
    monkeypatch.setattr(jax, "device_count", lambda: 2)
    config = load_config(["env=MountainCar", "algo=rnd", "cores=2", *options])
    made = place_on_cores(config, POOL, SINGLE_DEVICE)
    assert isinstance(made, CpuCores) if divided else made is SINGLE_DEVICE
