"""Tests of the named algorithms: the cell of each, and the settings that differ from its cell."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.rollouts import KINDS, rollout

import sndjax
from sndjax import gather_transitions
from sndjax.algorithms import NAMED
from sndjax.grid import OBJECTIVES, make_module

MODULES = {name: make for name, make in NAMED.items() if make is not None}
pytestmark = pytest.mark.usefixtures("quick_compilation")
VECTOR = KINDS[2]
CELLS = {
    "snd_v": ("contrastive", "distillation"),
    "snd_std": ("st_dim", "distillation"),
    "snd_vic": ("vicreg", "distillation"),
    "snd_vinv": ("vicreg_inverse", "distillation"),
    "snd_barlow": ("barlow_twins", "distillation"),
    "snd_byol": ("byol", "distillation"),
    "sp_vic": ("vicreg", "prediction"),
    "sp_vinv": ("vicreg_inverse", "prediction"),
}


def start(module, batch):
    params, state = jax.jit(module.init)(jax.random.key(0), batch.frames[0])
    rows = gather_transitions(batch, jnp.arange(batch.action.size))
    return params, state, (rows, batch, jax.random.key(2))


def value(module, batch):
    params, state, arguments = start(module, batch)
    return jax.jit(module.loss)(params, state, *arguments)


def test_NAMED_thirteen_algorithms_of_thesis_are_exported():
    assert set(NAMED) == {
        "ppo", "rnd", "snd_v", "snd_std", "snd_vic", "snd_vinv", "icm", "sp",
        "sp_vic", "sp_vinv", "snd_barlow", "snd_byol", "qrnd",
    }  # fmt: skip
    for name, make in MODULES.items():
        assert getattr(sndjax, name) is make


@pytest.mark.parametrize("name", CELLS)
def test_NAMED_snd_and_sp_algorithms_equal_their_make_module_cell(name):
    batch = rollout(VECTOR, np.random.default_rng(0))
    named = value(MODULES[name](VECTOR.actions, VECTOR.size), batch)
    same = value(sndjax.make_module(*CELLS[name], VECTOR.actions, VECTOR.size), batch)
    jax.tree.map(np.testing.assert_array_equal, named, same)


def test_rnd_reward_subtracts_running_mean_and_is_half_a_sum():
    batch = rollout(VECTOR, np.random.default_rng(0))
    module = MODULES["rnd"](VECTOR.actions, VECTOR.size)
    params, state, _ = start(module, batch)
    assert state.moments is not None
    assert (params.encoder, params.objective) == (
        None,
        None,
    )  # the target is no parameter: no optimizer updates it
    reward, _ = jax.jit(module.reward)(params, state, batch, jax.random.key(1))
    mean = OBJECTIVES["none"]._replace(distillation={"reward_reduction": "mean"})
    plain = make_module(mean, "distillation", VECTOR.actions, VECTOR.size, preprocess="mean")
    other, _ = jax.jit(plain.reward)(params, state, batch, jax.random.key(1))
    np.testing.assert_allclose(reward, other * 16 / 2, rtol=1e-5)


def test_snd_std_loss_sums_distillation_and_has_spread_term_and_sp_has_none():
    batch = rollout(VECTOR, np.random.default_rng(0))
    std, terms = value(MODULES["snd_std"](VECTOR.actions, VECTOR.size), batch)
    recipe = OBJECTIVES["st_dim"]._replace(distillation={})
    _, mean = value(make_module(recipe, "distillation", VECTOR.actions, VECTOR.size), batch)
    entries = 16 * int(batch.valid.sum())
    np.testing.assert_allclose(
        terms["distillation_loss"], mean["distillation_loss"] * entries, rtol=1e-4
    )
    np.testing.assert_allclose(std, terms["distillation_loss"] + terms["objective_loss"], rtol=1e-6)
    cross = lambda t: t["st_dim_global_local"] + t["st_dim_local_local"]
    norm = lambda t: 1e-4 * t["st_dim_logit_norm"]
    np.testing.assert_allclose(
        terms["objective_loss"], cross(terms) + norm(terms) - 1e-4 * terms["st_dim_spread"],
        rtol=1e-6,
    )  # fmt: skip
    sp, terms = value(MODULES["sp"](VECTOR.actions, VECTOR.size), batch)
    np.testing.assert_allclose(terms["objective_loss"], cross(terms) + norm(terms), rtol=1e-6)
    np.testing.assert_allclose(sp, terms["objective_loss"] + terms["prediction_loss"], rtol=1e-6)


def test_qrnd_reward_in_one_state_depends_on_action_and_rnd_does_not():
    batch = rollout(VECTOR, np.random.default_rng(0))
    same = batch._replace(frames=jnp.ones_like(batch.frames), valid=jnp.ones_like(batch.valid))
    for name, apart in (("qrnd", True), ("rnd", False)):
        module = MODULES[name](VECTOR.actions, VECTOR.size)
        params, state, _ = start(module, same)
        reward = np.asarray(jax.jit(module.reward)(params, state, same, jax.random.key(1))[0])
        by_action = [reward[np.asarray(same.action) == a] for a in range(VECTOR.actions)]
        for values in by_action:
            np.testing.assert_allclose(values, values[0], rtol=1e-5)
        assert (len({float(v[0]) for v in by_action}) > 1) == apart


def test_make_module_action_input_outside_qrnd_raises_value_error():
    with pytest.raises(ValueError, match="action_input"):
        make_module(OBJECTIVES["vicreg"], "distillation", 3, VECTOR.size, action_input=True)
    with pytest.raises(ValueError, match="action_input"):
        make_module(OBJECTIVES["none"], "noveld", 3, VECTOR.size, action_input=True)


@pytest.mark.parametrize("words", [("slow", "distillation"), ("vicreg", "surprise")])
def test_make_module_unknown_name_raises_with_known_names(words):
    with pytest.raises(ValueError, match="there is"):
        sndjax.make_module(*words, 3, VECTOR.size)


@pytest.mark.parametrize("kind", [KINDS[0]], ids=lambda kind: kind.name)
@pytest.mark.parametrize(
    "options",
    [{"activation": "published"}, {"activation": "relu"}, {"preprocess": "mean"},
     {"preprocess": "standardize"}, {"pairing": "one_linear"}, {"pairing": "two_linear"},
     {"pairing": "relu"}],
    ids=lambda o: "-".join(*o.items()),
)  # fmt: skip
def test_snd_vic_each_option_is_finite_and_changes_its_networks(options, kind):
    batch = rollout(kind, np.random.default_rng(0))
    module = MODULES["snd_vic"](kind.actions, kind.size, **options)
    params, state, arguments = start(module, batch)
    reward, _ = jax.jit(module.reward)(params, state, batch, jax.random.key(1))
    assert np.all(np.isfinite(reward))
    assert np.isfinite(jax.jit(module.loss)(params, state, *arguments)[0])
    dense = lambda part: sum(name.startswith("Dense") for name in getattr(params, part)["params"])
    linear = {"one_linear": (1, 1), "two_linear": (2, 2), "relu": (1, 1)}
    default = (1, 3) if kind.name != "vector" else (1, 1)
    wanted = linear.get(options.get("pairing"), default)
    assert (dense("encoder"), dense("signal")) == wanted
    assert (state.moments is not None) == ("preprocess" in options)


def test_module_loss_black_frames_has_finite_gradients():
    kind = KINDS[0]
    batch = rollout(kind, np.random.default_rng(0))
    batch = batch._replace(frames=jnp.zeros_like(batch.frames))
    for name in ("snd_std", "snd_barlow", "snd_byol", "snd_v"):
        module = MODULES[name](kind.actions, kind.size)
        params, state, arguments = start(module, batch)
        gradient = jax.jit(jax.grad(lambda p, m=module: m.loss(p, state, *arguments)[0]))(params)  # noqa: B023
        for leaf in jax.tree.leaves(gradient):
            assert np.all(np.isfinite(leaf))
