"""Compare a rollout with a plain loop over the same environments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sndjax
from experiments.config.compose import load_config
from experiments.environments.pools import make_pool, make_pools
from experiments.system.errors import ConfigError
from experiments.training.agents import build_agent, make_init_states
from experiments.training.placement import SINGLE_DEVICE
from experiments.training.rollouts import Collector
from sndjax.rollout import make_frame_stacker


@pytest.mark.parametrize("groups", [1, 2])
def test_Collector_collect_arrays_equal_those_of_environments_and_policy(groups):
    config = load_config(
        ["env=Venture", "algo=rnd", "num_seeds=2", "env.options.max_episode_steps=6",
         "num_envs=4", "rollout_length=16", "ppo.minibatch_size=64", "algo.minibatch_size=64"]
    )  # fmt: skip
    pools, plain = (
        make_pools(config.env, [0, 1], 4, groups=groups),
        make_pool(config.env, [0, 1], 4),
    )
    size = sndjax.ATARI._replace(channels=(4, 4, 4), last=4, rnd_channels=(4, 4, 4), features=8)
    agent = build_agent(config, pools[0])._replace(network=sndjax.ActorCritic(size, 18))
    example = jnp.zeros((4, 96, 96, 1), jnp.uint8)
    state = make_init_states(agent)([0, 1], example)
    actor = sndjax.Actor(state.policy, state.observations, state.key)
    collector = Collector(pools, agent, config, SINGLE_DEVICE)
    started = []
    frame = plain.reset()
    first = np.ones((2, 4), bool)
    for _ in range(2):  # the second rollout begins where the first ended
        batch, track = jax.tree.map(np.array, collector.collect(actor, beside=started.append))
        rollout = batch.rollout
        assert started[-16 * groups :] == [(i + 1) / (16 * groups) for i in range(16 * groups)]
        for t in range(16):
            np.testing.assert_array_equal(rollout.frames[:, t], frame)
            np.testing.assert_array_equal(rollout.first[:, t], first)
            step = plain.step(rollout.action[:, t])
            for name, got in (
                ("reward", batch.reward),
                ("truncated", batch.truncated),
                ("done", rollout.done),
                ("valid", rollout.valid),
                ("score", track.score),
            ):
                np.testing.assert_array_equal(got[:, t], getattr(step, name), err_msg=name)
            frame, first = step.frame, ~step.valid
        np.testing.assert_array_equal(rollout.frames[:, 16], frame)
        assert (~rollout.valid).sum() >= 8
        for seed in range(2):
            own = jax.tree.map(lambda x: jnp.asarray(x[seed]), batch)  # noqa: B023
            stacks = make_frame_stacker(own, agent.stack)(jnp.arange(64))
            policy = jax.tree.map(lambda x: x[seed], state.policy)  # noqa: B023
            logits, value = agent.network.apply(policy, stacks)
            log_p = jax.nn.log_softmax(logits)[jnp.arange(64), own.rollout.action.reshape(-1)]
            valid = np.asarray(own.rollout.valid).reshape(-1)
            np.testing.assert_allclose(
                np.asarray(log_p)[valid], own.log_prob.reshape(-1)[valid], rtol=1e-4
            )
            np.testing.assert_allclose(
                np.asarray(value)[valid], own.value[:-1].reshape(64, 2)[valid], atol=1e-5
            )


@pytest.mark.parametrize(("network", "size"), [("thesis", sndjax.PROCGEN), ("small", sndjax.SMALL)])
def test_build_agent_pixels_use_the_chosen_network(network, size):
    config = load_config(["env=Jumper", "algo=snd_vic", f"network={network}", "num_envs=4"])
    pools = make_pools(config.env, config.seeds, config.num_envs)
    agent = build_agent(config, pools[0])
    assert agent.network.architecture == size
    frames = jnp.asarray(pools[0].reset()[0])
    state = jax.eval_shape(lambda: sndjax.init_train_state(agent, jax.random.key(0), frames))
    kernels = [x.shape for x in jax.tree.leaves(state.intrinsic) if len(x.shape) == 4]
    assert kernels[0] == ((4, 4, 3, 16) if network == "small" else (3, 3, 3, 32))


def test_build_agent_network_for_vectors_is_refused():
    config = load_config(["env=MountainCar", "algo=rnd", "network=small"])
    with pytest.raises(ConfigError, match="is for pixels; MountainCar-v0 has none"):
        build_agent(config, make_pools(config.env, config.seeds, 2)[0])
