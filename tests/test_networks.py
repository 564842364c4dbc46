"""Tests of sizes, computed by hand from the thesis' network table, and of initial weights."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sndjax import ATARI, PROCGEN, SMALL, VECTOR, ActorCritic, snd_std
from sndjax.algorithms import NAMED
from sndjax.grid import OBJECTIVES, make_encoder_and_predictor


def count(tree):
    return sum(int(np.prod(x.shape)) for x in jax.tree.leaves(tree))


FRAMES = {
    "atari": ((96, 96, 1), ATARI, 18),
    "procgen": ((64, 64, 3), PROCGEN, 15),
    "small": ((64, 64, 3), SMALL, 15),
    "vector": ((2,), VECTOR, 3),
}
# 9*1*32+32 + 9*32*64+64 + 9*64*64+64 + 9*64*128+128 + 12*12*128*512+512, and so on.
ENCODERS = [
    ("snd_std", "atari", 9_567_296, 10_092_608),
    ("snd_vic", "atari", 9_567_296, 10_092_608),
    ("snd_vinv", "atari", 9_567_296, 10_092_608),
    ("snd_barlow", "atari", 9_567_296, 10_092_608),
    ("snd_byol", "atari", 9_567_296, 10_092_608),
    # 9*1*16+16 + 9*16*32+32 + 9*32*64+64 + 9*64*64+64 + 12*12*64*512+512
    ("snd_v", "atari", 4_779_328, 5_304_640),
    ("rnd", "atari", 4_776_608, 5_301_920),
    ("qrnd", "atari", 4_776_608 + 18 * 512, 5_301_920 + 18 * 512),
    ("snd_std", "procgen", 2_190_912, 2_716_224),
    ("snd_vic", "procgen", 2_190_912, 4_850_304),
    ("snd_vinv", "procgen", 2_190_912, 4_850_304),
    # 9*3*16+16 + 9*16*32+32 + 9*32*64+64 + 9*64*64+64 + 8*8*64*512+512
    ("snd_v", "procgen", 2_158_176, 2_683_488),
    ("rnd", "procgen", 2_159_264, 2_684_576),
    # 16*3*16+16 + 9*16*32+32 + 9*32*32+32 + 9*32*32+32 + 4*4*32*128+128, and 2*(128*128+128)
    *((name, "small", 89_584, 122_608) for name in ("snd_std", "snd_vic", "snd_v", "rnd")),
    ("snd_std", "vector", 8_512, 8_512),
    ("snd_vic", "vector", 8_512, 8_512),
    ("snd_v", "vector", 8_512, 8_512),
    ("rnd", "vector", 8_512, 8_512),
    ("qrnd", "vector", 8_512 + 3 * 64, 8_512 + 3 * 64),
]
# Encoder; forward model d+A -> d -> d -> d, (512+18)*512+512 + 2*(512*512+512); networks of the
# objective.
PREDICTORS = [
    ("sp", "atari", 9_567_296, 797_184, 36_992),
    ("sp_vic", "atari", 9_567_296, 797_184, 0),
    ("sp_vinv", "atari", 9_567_296, 797_184, 660_754),  # 1024 -> 512 -> 256 -> 18
    ("icm", "atari", 9_567_296, 797_184, 796_690),  # 1024 -> 512 -> 512 -> 18
    ("sp", "procgen", 2_190_912, 795_648, 36_992),
    ("icm", "procgen", 2_190_912, 795_648, 795_151),
    ("icm", "vector", 8_512, 12_672, 12_611),
]


def example(kind):
    shape, _, _ = FRAMES[kind]
    return jnp.zeros((2, *shape), jnp.uint8 if len(shape) == 3 else jnp.float32)


@pytest.mark.parametrize(("name", "kind", "target", "learned"), ENCODERS)
def test_NAMED_encoder_and_predictor_have_parameter_counts_of_thesis_table(
    name, kind, target, learned
):
    _, size, actions = FRAMES[kind]
    module = NAMED[name](actions, size)
    params, state = jax.eval_shape(module.init, jax.random.key(0), example(kind))
    assert count(state.encoder if params.encoder is None else params.encoder) == target
    assert count(params.signal) == learned
    if name == "snd_std":
        width, local = {"vector": (64, 64), "small": (128, 32)}.get(kind, (512, 64))
        assert count(params.objective) == width * local + local + local * local + local
    if name == "snd_byol":
        # d -> d -> d/2 and d/2 -> d -> d/2, twice with the slow copy.
        heads = 512 * 512 + 512 + 512 * 256 + 256 + 256 * 512 + 512 + 512 * 256 + 256
        assert count(params.objective) == heads
        assert count(state.slow) == target + heads


@pytest.mark.parametrize(("name", "kind", "encoder", "forward", "objective"), PREDICTORS)
def test_NAMED_forward_model_and_objective_have_parameter_counts_of_thesis_table(
    name, kind, encoder, forward, objective
):
    _, size, actions = FRAMES[kind]
    params, _ = jax.eval_shape(NAMED[name](actions, size).init, jax.random.key(0), example(kind))
    assert count(params.encoder) == encoder
    assert count(params.signal) == forward
    assert count(params.objective) == objective


@pytest.mark.parametrize(
    ("kind", "stack", "parameters"),
    [("atari", 4, 10_103_732), ("procgen", 2, 2_725_809), ("vector", 1, 17_157)],
)
def test_ActorCritic_has_parameter_count_of_thesis_table(kind, stack, parameters):
    shape, size, actions = FRAMES[kind]
    stacked = jnp.zeros((2, *shape[:-1], shape[-1] * stack), example(kind).dtype)
    network = ActorCritic(size, actions)
    params = jax.eval_shape(network.init, jax.random.key(0), stacked)
    assert count(params) == parameters
    logits, value = jax.eval_shape(network.apply, params, stacked)
    assert logits.shape == (2, actions)
    assert value.shape == (2, 2)


@pytest.mark.parametrize(
    ("kind", "local"), [("atari", (12, 12, 64)), ("procgen", (8, 8, 64)), ("vector", (1, 1, 64))]
)
def test_make_encoder_and_predictor_local_map_is_third_layer(kind, local):
    _, size, _ = FRAMES[kind]
    target, _ = make_encoder_and_predictor(OBJECTIVES["st_dim"], size, "elu", "asymmetric")
    params = jax.eval_shape(target.init, jax.random.key(0), example(kind))
    z, maps = jax.eval_shape(target.apply, params, example(kind))
    assert z.shape == (2, size.features)
    assert maps.shape == (2, *local)


def test_ActorCritic_init_is_orthogonal_with_gains_of_thesis_table_and_zero_biases():
    network = ActorCritic(VECTOR, 3)
    params = network.init(jax.random.key(0), jnp.zeros((1, 2)))["params"]
    root = np.sqrt(2)
    gains = {"Dense_0": root, "Dense_1": 0.01, "Dense_2": 0.01, "Dense_3": 0.1, "Dense_4": 0.01}
    gains |= {"Dense_5": 0.01}
    for name, gain in gains.items():
        kernel = np.asarray(params[name]["kernel"], np.float64)
        np.testing.assert_allclose(np.linalg.svd(kernel)[1], gain, rtol=1e-4)
        assert not np.any(params[name]["bias"])
    assert set(params) == {*gains, "Torso_0"}


def test_snd_std_init_convolutions_are_orthogonal_with_gain_of_thesis_table():
    module = snd_std(18)
    params, _ = module.init(jax.random.key(0), example("atari"))
    for encoder in (params.encoder, params.signal):
        torso = encoder["params"]["Torso_0"]
        for i in range(4):
            kernel = np.asarray(torso[f"kernel_{i}"], np.float64)
            kernel = kernel.reshape(-1, kernel.shape[-1])
            np.testing.assert_allclose(np.linalg.svd(kernel)[1], 0.5, rtol=1e-4)
            assert not np.any(torso[f"bias_{i}"])


def test_ActorCritic_one_value_head_has_an_extra_relu():
    one = ActorCritic(VECTOR, 3, value_heads=1)
    x = jnp.ones((4, 2))
    params = one.init(jax.random.key(0), x)
    torso = jax.tree.map(jnp.zeros_like, params)
    torso["params"]["Dense_0"]["bias"] -= 1.0  # a negative torso output, which the ReLU sets to 0
    torso["params"]["Dense_3"]["kernel"] += 1.0
    torso["params"]["Dense_4"]["kernel"] += 1.0
    assert np.all(one.apply(torso, x)[1] == 0)
    assert one.apply(params, x)[1].shape == (4, 1)


GAINS = [
    ("none", 2**0.5, 2**0.5), ("contrastive", 2**0.5, 2**0.5), ("st_dim", 0.5, 0.5),
    ("vicreg", 0.5, 2**0.5), ("vicreg_inverse", 0.5, 2**0.5), ("inverse_dynamics", 2**0.5, None),
]  # fmt: skip


@pytest.mark.parametrize(("objective", "encoder", "learned"), GAINS)
def test_make_encoder_and_predictor_has_gains_and_activations_of_thesis_table(
    objective, encoder, learned
):
    recipe = OBJECTIVES[objective]
    for activation, torso, between in (
        ("elu", "elu", "elu"),
        ("relu", "relu", "relu"),
        ("published", "elu" if objective in ("none", "contrastive") else "relu", "elu"),
    ):
        made = make_encoder_and_predictor(recipe, ATARI, activation, "asymmetric")
        assert [(n.activation, n.extra_activation) for n in made] == [(torso, between)] * 2
        assert made[0].gain == pytest.approx(encoder)
        if learned is not None:
            assert made[1].gain == pytest.approx(learned)


@pytest.mark.parametrize(
    ("pairing", "linear"),
    [("asymmetric", (1, 3)), ("one_linear", (1, 1)), ("two_linear", (2, 2)), ("relu", (1, 1))],
)
def test_make_encoder_and_predictor_pairing_has_layers_of_figure_5_4(pairing, linear):
    target, learned = make_encoder_and_predictor(OBJECTIVES["vicreg"], PROCGEN, "elu", pairing)
    assert (target.extra + 1, learned.extra + 1) == linear
    same = target.convolutions == learned.convolutions
    assert same == (pairing != "asymmetric")
    assert target.activation == ("relu" if pairing == "relu" else "elu")


def test_ActorCritic_init_under_vmap_factorizes_one_matrix_at_a_time():
    """Batched factorizations wait for each other for ever on two cores (jaxlib 0.10.2)."""
    network = ActorCritic(VECTOR, 3)
    init = lambda key: network.init(key, jnp.zeros((1, 5)))
    keys = jax.random.split(jax.random.key(0), 3)
    text = str(jax.make_jaxpr(jax.vmap(init))(keys))
    factors = re.findall(r":f32\[([^]]*)\] \w+:f32\[[^]]*\] = qr\[", text)
    assert factors
    assert all(len(shape.split(",")) == 2 for shape in factors)
    together = jax.vmap(init)(keys)
    for i, key in enumerate(keys):
        jax.tree.map(
            lambda x, one, i=i: np.testing.assert_array_equal(x[i], one), together, init(key)
        )
