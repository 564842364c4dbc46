"""Rollouts in one program against those of the collector that steps in Python."""

import jax
import numpy as np
import pytest

import sndjax
from experiments.config.compose import load_config
from experiments.training.experiment import build_experiment
from experiments.training.placement import SINGLE_DEVICE
from experiments.training.rollouts import Collector
from experiments.training.scan_collector import ScanCollector

SMALL = ["num_envs=8", "rollout_length=50", "ppo.minibatch_size=50"]
SND, RND = (["algo.minibatch_size=50", f"algo={name}"] for name in ("snd_vic", "rnd"))


def collectors(config):
    """Return both collectors, each with environments of its own, and an actor."""
    experiment, other = build_experiment(config), build_experiment(config)
    state = experiment.init_states()
    host = Collector(other.pools, other.agent, config, SINGLE_DEVICE)
    actor = sndjax.Actor(state.policy, state.observations, state.key)
    return experiment.make_collector(), host, actor


@pytest.mark.parametrize(
    "arguments",
    [
        ["env=MountainCar", *SND, "env.options.max_episode_steps=30"],
        ["env=MountainCar", *RND, "num_seeds=3", "env.options.max_episode_steps=30"],
        ["env=MountainCar", *RND, "network.memory=gru", "env.options.max_episode_steps=30"],
        ["env=MiniGrid", "env.id=MiniGrid-DoorKey-5x5-v0", "algo=ppo", "env.stack=3"],
        ["env=envpool", "env.id=FrozenLake-v1", "algo=ppo", "num_seeds=2"],
        ["env=envpool", "env.id=CartPole-v1", *RND, "env.reward=goal"],
    ],
    ids=lambda x: x[1],
)
def test_ScanCollector_rollouts_equal_those_of_Collector(arguments):
    scan, host, actor = collectors(load_config([*arguments, *SMALL]))
    assert isinstance(scan, ScanCollector)
    resets, rollouts = 0, 20 if "env=MiniGrid" in arguments else 3  # its episodes are long
    for _ in range(rollouts):
        # One after the other: the buffers of a collector are reused by its next rollout.
        (batch, info), (wanted, wanted_info) = scan.collect(actor), host.collect(actor)
        resets += int((~wanted_info.valid).sum())
        leaves = (jax.tree.leaves(tree) for tree in ((batch, info), (wanted, wanted_info)))
        for mine, theirs in zip(*leaves, strict=True):
            mine, theirs = np.asarray(mine), np.asarray(theirs)
            assert mine.shape == theirs.shape
            assert mine.dtype == theirs.dtype
            # Scaling observations divides here and multiplies there.
            np.testing.assert_allclose(mine, theirs, rtol=1e-5, atol=1e-6)
    assert resets > 5
    scan.close()
    host.close()
