"""The presets that repeat other projects' settings: their numbers, and their arithmetic in float64.

The constants here are those of the other project, under its own names, as its source has them.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.rollouts import KINDS, rollout

from experiments.config.compose import load_config
from experiments.config.validation import group_choices
from experiments.training.agents import make_hyperparameters, make_intrinsic_config
from sndjax import (
    VECTOR,
    Rollout,
    distillation_error,
    elliptical_bonus,
    gather_transitions,
    ppo,
)

KIND = KINDS[2]

CRAFTAX = {
    "num_envs": 1024, "num_steps": 64, "lr": 2e-4, "update_epochs": 4, "num_minibatches": 8,
    "gamma": 0.99, "gae_lambda": 0.8, "clip_eps": 0.2, "ent_coef": 0.01, "vf_coef": 0.5,
    "max_grad_norm": 1.0, "anneal_lr": True, "adam_eps": 1e-5,
}  # fmt: skip
CLEANRL = {
    "num_envs": 128, "num_steps": 128, "lr": 1e-4, "update_epochs": 4, "num_minibatches": 4,
    "gamma": 0.999, "gae_lambda": 0.95, "clip_eps": 0.1, "ent_coef": 0.001, "vf_coef": 0.5,
    "max_grad_norm": 0.5, "anneal_lr": True, "adam_eps": 1e-5,
}  # fmt: skip
BURDA = {
    "num_envs": 32, "num_steps": 128, "lr": 1e-4, "update_epochs": 4, "num_minibatches": 4,
    "gamma": 0.999, "gae_lambda": 0.95, "clip_eps": 0.1, "ent_coef": 0.001, "vf_coef": 1.0,
    "max_grad_norm": 1e9, "anneal_lr": False, "adam_eps": 1e-8,
}  # fmt: skip
MINIGRID = ["env=MiniGrid", "env.id=MiniGrid-DoorKey-8x8-v0"]
CRAFT = ["env=craftax", "env.id=Craftax-Classic-Symbolic-v1"]
TASKS = {
    "cleanrl_rnd": ["env=MontezumaRevenge"],
    "burda_rnd": ["env=MontezumaRevenge"],
    "craftax_rnd": CRAFT,
    "craftax_icm": CRAFT,
    "craftax_e3b": CRAFT,
    "noveld": MINIGRID,
    "ngu": MINIGRID,
}
PPO = {
    "cleanrl_rnd": CLEANRL,
    "burda_rnd": BURDA,
    "craftax_rnd": CRAFTAX,
    "craftax_icm": CRAFTAX,
    "craftax_e3b": CRAFTAX,
}


def of_preset(name, *more):
    return load_config([*TASKS[name], f"preset={name}", *more])


def batch(seed, heads, rows=4096, actions=5):
    rng = np.random.default_rng(seed)
    return {
        "logits": rng.normal(size=(rows, actions)),
        "value": rng.normal(size=(rows, heads)),
        "action": rng.integers(0, actions, rows),
        "old_log_prob": -np.abs(rng.normal(size=rows)) - 1,
        "advantage": rng.normal(size=rows) * 3 + 1,
        "target": rng.normal(size=(rows, heads)),
        "old_value": rng.normal(size=(rows, heads)),
    }


def published_loss(name, c, source):
    """Compute the loss of the other project's source, in float64 and its own order."""
    log_p = c["logits"] - np.log(np.exp(c["logits"]).sum(-1, keepdims=True))
    action = c["action"]
    ratio = np.exp(log_p[np.arange(len(action)), action] - c["old_log_prob"])
    advantage, clip = c["advantage"], source["clip_eps"]
    if name != "burda_rnd":  # torch divides by n - 1, jax by n
        deviation = advantage.std(ddof=1 if name == "cleanrl_rnd" else 0)
        advantage = (advantage - advantage.mean()) / (deviation + 1e-8)
    surrogate = np.minimum(ratio * advantage, np.clip(ratio, 1 - clip, 1 + clip) * advantage)
    value_loss = 0.0
    for k in range(c["value"].shape[1]):
        value, old, target = (c[key][:, k] for key in ("value", "old_value", "target"))
        squares = (value - target) ** 2
        clipped = {"cleanrl_rnd": k == 0, "burda_rnd": False}.get(name, True)
        if clipped:
            near = old + np.clip(value - old, -clip, clip)
            squares = np.maximum(squares, (near - target) ** 2)
        value_loss += 0.5 * squares.mean()
    entropy = -(np.exp(log_p) * log_p).sum(-1).mean()
    return -surrogate.mean() + source["vf_coef"] * value_loss - source["ent_coef"] * entropy


@pytest.mark.parametrize("name", PPO)
def test_preset_ppo_loss_equals_the_published_one_in_float64(name):
    hyper = make_hyperparameters(of_preset(name))
    heads = 1 if hyper.combine == "sum" else 2
    for seed in range(3):
        c = batch(seed, heads)
        arrays = {key: jnp.asarray(value, jnp.float32) for key, value in c.items()}
        arrays |= {"action": jnp.asarray(c["action"], jnp.int32), "valid": jnp.ones(4096, bool)}
        total, _ = ppo.loss(**arrays, hyper=hyper)
        np.testing.assert_allclose(total, published_loss(name, c, PPO[name]), rtol=1e-3)


@pytest.mark.parametrize("name", PPO)
def test_preset_ppo_settings_are_the_published_ones(name):
    config, source = of_preset(name), PPO[name]
    assert (config.num_envs, config.rollout_length) == (source["num_envs"], source["num_steps"])
    rows = source["num_envs"] * source["num_steps"] // source["num_minibatches"]
    assert (config.ppo.minibatch_size, config.algo.minibatch_size) == (rows, rows)
    hyper = make_hyperparameters(config)
    assert (hyper.learning_rate, hyper.adam_eps) == (source["lr"], source["adam_eps"])
    assert (hyper.epochs, hyper.max_grad_norm) == (
        source["update_epochs"],
        source["max_grad_norm"],
    )
    assert (hyper.gamma_ext, hyper.gae_lambda) == (source["gamma"], source["gae_lambda"])
    assert (hyper.anneal_iterations == config.iterations) == source["anneal_lr"]
    assert hyper.gamma_int == 0.99


def published_reward(name, error):
    """Compute the scaled bonus of one step's squared errors [N, d], before any running scale."""
    return {
        "cleanrl_rnd": error.sum(-1) / 2,
        "burda_rnd": error.mean(-1),
        "craftax_rnd": 1.0 * error.mean(-1),
    }[name]


@pytest.mark.parametrize("name", ["cleanrl_rnd", "burda_rnd", "craftax_rnd"])
def test_preset_rnd_reward_and_scale_are_the_published_ones(name):
    config = of_preset(name)
    intrinsic = make_intrinsic_config(config, 5, VECTOR._replace(features=16))
    rng = np.random.default_rng(0)
    one, other = rng.normal(size=(2, 7, 16)).astype(np.float32)
    reduction = config.signal["reward_reduction"]
    got = np.asarray(distillation_error(jnp.asarray(one), jnp.asarray(other), reduction))
    wanted = published_reward(name, (one - other).astype(np.float64) ** 2)
    if intrinsic.reward_scale == "running_std":  # then a constant factor does not count
        got, wanted = got / got.std(), wanted / wanted.std()
    np.testing.assert_allclose(got, wanted, rtol=1e-5)
    assert (intrinsic.reward_scale == "running_std") == (name != "craftax_rnd")
    weights = {"cleanrl_rnd": (2.0, 1.0), "burda_rnd": (2.0, 1.0), "craftax_rnd": (1.0, 0.01)}
    assert (config.ppo.ext_weight, config.ppo.int_weight) == weights[name]
    assert not config.ppo.episodic_int


def module_and_rows(name):
    """Return a preset's module at toy size, its parameters, and a minibatch of 32 rows."""
    size = VECTOR._replace(features=8, hidden=(8,))
    module = make_intrinsic_config(of_preset(name), KIND.actions, size).module
    made = rollout(KIND, np.random.default_rng(0), chance=0.0)
    made = made._replace(valid=jnp.ones_like(made.valid))
    params, state = jax.jit(module.init)(jax.random.key(0), made.frames[0])
    rows = gather_transitions(made, jnp.arange(32))
    loss = jax.jit(module.loss)(params, state, rows, made, jax.random.key(1))
    features = lambda frames: np.asarray(
        module.features(params, state, frames, rows.action), np.float64
    )
    return params, rows, loss, features


def dense(weights, x):
    return x @ np.asarray(weights["kernel"], np.float64) + np.asarray(weights["bias"], np.float64)


def test_preset_craftax_rnd_trains_a_hundredth_of_the_mean_squared_error():
    params, rows, (total, _), features = module_and_rows("craftax_rnd")
    weights = params.signal["params"]
    hidden = np.maximum(dense(weights["Torso_0"]["Dense_0"], np.asarray(rows.frame)), 0)
    error = dense(weights["Dense_0"], hidden) - features(rows.frame)
    np.testing.assert_allclose(total, 0.01 * (error**2).mean(), rtol=1e-4)  # rnd_loss_coeff


def test_preset_craftax_icm_adds_both_losses_with_weight_one():
    params, rows, (total, terms), features = module_and_rows("craftax_icm")
    z, z_next = features(rows.frame), features(rows.next_frame)
    x, layers = np.concatenate([z, z_next], -1), params.objective["params"]
    for i in range(3):
        x = dense(layers[f"Dense_{i}"], x if i == 0 else np.maximum(x, 0))
    log_p = x - np.log(np.exp(x).sum(-1, keepdims=True))
    inverse = -log_p[np.arange(32), np.asarray(rows.action)].mean()
    x = np.concatenate([z, np.eye(KIND.actions)[np.asarray(rows.action)]], -1)
    for i in range(3):
        x = dense(params.signal["params"][f"Dense_{i}"], x if i == 0 else np.maximum(x, 0))
    forward = ((x - z_next) ** 2).mean()
    np.testing.assert_allclose(terms["inverse_dynamics"], inverse, rtol=1e-4)
    np.testing.assert_allclose(terms["prediction_loss"], forward, rtol=1e-4)
    np.testing.assert_allclose(total, inverse + forward, rtol=1e-4)


def test_preset_craftax_e3b_matrix_and_bonus_are_the_published_ones():
    """Step the published matrix C^-1 by its own formula; ours is its root, one state ahead."""
    ridge = of_preset("craftax_e3b").signal["ridge"]
    rng = np.random.default_rng(0)
    steps, envs, d = 12, 3, 4
    z = rng.normal(size=(steps + 1, envs, d))
    first = np.zeros((steps, envs), bool)
    first[0] = True
    no, yes = np.zeros((steps, envs), bool), np.ones((steps, envs), bool)
    root = np.broadcast_to(np.eye(d) / np.sqrt(ridge), (envs, d, d))
    rollout = Rollout(jnp.zeros((steps + 1, envs, 1)), jnp.zeros((steps, envs), int), *map(
        jnp.asarray, (first, no, yes)
    ))  # fmt: skip
    got, _ = jax.jit(elliptical_bonus, static_argnames="ridge")(
        jnp.asarray(root, jnp.float32), jnp.asarray(z, jnp.float32), rollout, ridge=ridge
    )
    matrix = np.repeat(np.eye(d)[None], envs, 0) / 0.1  # E3B_LAMBDA
    for t in range(steps + 1):
        u = np.einsum("nij,nj->ni", matrix, z[t])
        b = np.einsum("ni,ni->n", z[t], u)
        if t:
            np.testing.assert_allclose(got[t - 1], b, rtol=1e-3)
        matrix = matrix - (1 / (1 + b))[:, None, None] * u[:, :, None] * u[:, None, :]


def test_preset_icm_and_e3b_sum_rewards_before_one_value():
    for name in ("craftax_icm", "craftax_e3b"):
        config = of_preset(name)
        hyper = make_hyperparameters(config)
        reward, bonus = jnp.array([[1.0, 0.0]]), jnp.array([[0.25, 3.0]])
        np.testing.assert_array_equal(ppo.combine_rewards(hyper, reward, bonus), [[1.25, 3.0]])
        module = (config.algo.learning_rate, config.algo.epochs, config.algo.max_grad_norm)
        assert module == (3e-4, 4, 1.0)
        assert config.network.module.features == 32
    icm = of_preset("craftax_icm")
    assert (icm.algo.objective_weight, icm.algo.signal_weight) == (1.0, 1.0)
    assert icm.signal == {"gradient": "asymmetric", "reward_reduction": "mean"}


def test_preset_noveld_and_ngu_have_the_published_constants():
    noveld = of_preset("noveld")
    assert (noveld.algo.eta, noveld.ppo.entropy_weight, noveld.ppo.max_grad_norm) == (
        0.05,
        0.0005,
        40.0,
    )
    assert (noveld.signal["alpha"], noveld.signal["novelty"]) == (0.5, "norm")
    # baseline_cost times the 0.5 of the squares; the predictor's gradient is clipped too.
    assert (noveld.ppo.value_weight, noveld.algo.max_grad_norm) == (0.5 * 0.5, 40.0)
    ngu = of_preset("ngu")
    assert (ngu.algo.eta, ngu.algo.learning_rate, ngu.algo.adam_eps) == (0.3, 5e-4, 1e-4)
    wanted = {"neighbours": 10, "epsilon": 1e-4, "cluster": 0.008, "constant": 1e-3}
    wanted |= {"max_similarity": 8.0, "max_lifelong_factor": 5.0}
    assert wanted.items() <= ngu.signal.items()


def test_every_preset_with_a_source_is_in_this_file_and_another_value_wins():
    assert set(group_choices("preset")) == {*TASKS, "laptop"}
    config = of_preset("craftax_rnd", "ppo.clip=0.3", "network.policy.hidden=[64]", "algo=snd_vic",
                       "signal.reward_reduction=norm")  # fmt: skip
    assert (config.ppo.clip, config.network.policy.hidden) == (0.3, [64])
    assert (config.algo.name, config.signal["reward_reduction"]) == ("snd_vic", "norm")
