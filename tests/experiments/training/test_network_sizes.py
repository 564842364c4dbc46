"""The sizes of networks that options ask for, and the ones that are impossible."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sndjax
from experiments.config.compose import load_config
from experiments.system.errors import ConfigError
from experiments.training.agents import build_agent
from experiments.training.network_sizes import network_sizes

GRAY, COLOUR, VECTOR = ((96, 96, 1), np.uint8), ((64, 64, 3), np.uint8), ((8,), np.float32)


def pool_of(kind):
    shape, dtype = kind
    return SimpleNamespace(shape=shape, dtype=dtype, num_actions=3, unbounded=())


def sizes(kind, *options, part="policy", algo="snd_vic"):
    config = load_config(["env=MountainCar", f"algo={algo}", *options])
    return network_sizes(config, pool_of(kind), part)


def test_network_sizes_named_networks_are_those_of_the_library():
    assert sizes(GRAY) == sndjax.ATARI
    assert sizes(COLOUR) == sndjax.PROCGEN
    assert sizes(VECTOR) == sndjax.VECTOR
    assert sizes(COLOUR, "network=small") == sndjax.SMALL
    assert sizes(GRAY, "network=wide").features == 2 * sndjax.ATARI.features
    assert sizes(GRAY, "network=wide").channels == tuple(2 * c for c in sndjax.ATARI.channels)
    assert sizes(VECTOR, "network=wide").hidden == (512, 512)
    assert sizes(COLOUR, "network=mlp").channels == ()
    assert sizes(VECTOR, "network=mlp") == sndjax.VECTOR


def test_network_sizes_of_any_pixels_are_those_of_earlier_versions():
    """Gray ones have Atari's, all others Procgen's, whatever their channels and sides."""
    for channels, wanted in ((1, sndjax.ATARI), (2, sndjax.PROCGEN), (4, sndjax.PROCGEN)):
        for side in (20, 64):
            kind = ((side, side, channels), np.uint8)
            assert sizes(kind) == wanted
            assert sizes(kind, "network=small") == sndjax.SMALL


def test_network_sizes_of_a_part_come_before_those_of_all():
    options = ("network.hidden=[32,16]", "network.policy.hidden=[8]", "network.features=24",
               "network.module.features=4", "network.layer_norm=true")  # fmt: skip
    policy, module = (sizes(VECTOR, *options, part=part) for part in ("policy", "module"))
    assert (policy.hidden, policy.features, policy.layer_norm) == ((8,), 24, True)
    assert (module.hidden, module.features, module.layer_norm) == ((32, 16), 4, True)
    channels = sizes(GRAY, "network.channels=[8,16]", "network.last=4", part="module")
    assert channels.channels == channels.rnd_channels == channels.snd_v_channels == (8, 16)
    assert (channels.last, channels.last_predictor) == (4, 4)
    assert sizes(GRAY, "network.channels=[]", "network.hidden=[7]").hidden == (7,)


def test_network_memory_is_the_policys_alone():
    assert sizes(VECTOR, "network.memory=gru").memory == "gru"
    assert sizes(VECTOR, "network.memory=gru", part="module").memory == "none"


@pytest.mark.parametrize(
    ("kind", "options", "words"),
    [
        (VECTOR, ["network.channels=[8]"], "network.channels=[8]: the observations are vectors"),
        (VECTOR, ["network.policy.patch=4"], "network.policy.patch=4: these networks have no conv"),
        (VECTOR, ["network=small"], "is for pixels"),
        (
            COLOUR,
            ["network=mlp", "network.channels=[8]", "network.hidden=[8]"],
            "convolutions read",
        ),
        (COLOUR, ["network=mlp", "network.last=8"], "these networks have no convolutions"),
        (GRAY, ["network.hidden=[8]"], "hidden layers are those of network=mlp"),
        (COLOUR, ["network.patch=65"], "network.patch=65: layer 1 would make a map of 0 x 0 x 32"),
    ],
)
def test_network_sizes_impossible_ones_are_refused_with_the_shape(kind, options, words):
    with pytest.raises(ConfigError) as refused:
        sizes(kind, *options)
    assert words in str(refused.value)
    assert "shape" in str(refused.value) or "small" in str(refused.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["network.hidden=[]x"], "cannot read"),
        (["network.hidden=[0]"], "at least 1"),
        (["network.hidden=[8.5]"], "whole numbers"),
        (["network.hidden=8"], "write a list, such as network.hidden=[8]"),
        (["network.features=0"], "at least 1"),
        (["network.activation=gelu"], "unknown value of network.activation"),
        (["network.activation=published"], "network.module.activation=published"),
        (["network=huge"], "known: mlp, small, thesis, wide"),
        (["network.memory=gru", "ppo.minibatch_size=64"], "rollout_length=128 times a divisor"),
    ],
)
def test_load_config_network_options_that_cannot_be_are_refused(options, words):
    with pytest.raises(ConfigError) as refused:
        load_config(["env=MountainCar", "algo=rnd", *options])
    assert words in str(refused.value)


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (VECTOR, ["network.activation=tanh", "network.layer_norm=true", "network.hidden=[8,8,8]"]),
        (VECTOR, ["network=wide", "network.features=2", "network.memory=gru"]),
        (COLOUR, ["network.channels=[4]", "network.last=4", "network.features=6"]),
        (COLOUR, ["network=mlp", "network.activation=leaky_relu", "network.hidden=[8]"]),
        (GRAY, ["network.patch=8", "network.channels=[4,4,4,4]", "network.features=6"]),
    ],
)
@pytest.mark.parametrize("algo", ["rnd", "snd_v", "snd_std", "snd_byol"])
def test_build_agent_any_sizes_make_finite_outputs_of_their_shapes(kind, options, algo):
    config = load_config(["env=MountainCar", f"algo={algo}", *options])
    agent = build_agent(config, pool_of(kind))
    example = jnp.ones((2, *kind[0]), kind[1])
    state = jax.eval_shape(lambda: sndjax.init_train_state(agent, jax.random.key(0), example))
    features = agent.intrinsic.module.features
    found = jax.eval_shape(
        features, state.intrinsic, state.intrinsic_state, example, jnp.zeros(2, jnp.int32)
    )
    assert found.shape == (2, agent.network.architecture.features)
    logits, value = jax.eval_shape(agent.network.apply, state.policy, example)
    assert (logits.shape, value.shape) == ((2, 3), (2, 2))


def test_layer_norm_and_activation_change_the_policys_output():
    """A hidden layer of one unit and layer normalisation can only say its bias."""
    config = load_config(["env=MountainCar", "algo=ppo", "network.hidden=[1]"])
    normed = load_config(
        ["env=MountainCar", "algo=ppo", "network.hidden=[1]", "network.layer_norm=true"]
    )
    rows = jnp.linspace(-3, 3, 10).reshape(5, 2)
    for made, moves in ((config, True), (normed, False)):
        agent = build_agent(made, pool_of(((2,), np.float32)))
        params = agent.network.init(jax.random.key(3), rows)
        logits, _ = agent.network.apply(params, rows)
        assert (np.ptp(np.asarray(logits), axis=0).max() > 1e-6) == moves
