"""One suite over every named algorithm and every kind of input."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from builders import KINDS, rollout

from sndjax import IntrinsicModule, transitions
from sndjax.algorithms import NAMED

MODULES = {name: make for name, make in NAMED.items() if make is not None}
pytestmark = [
    pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name),
    pytest.mark.parametrize("name", MODULES),
]


@functools.cache
def made(name, kind, activation="elu", preprocess=None):
    """A module whose functions are jitted, with its params, its state and a rollout."""
    options = {"activation": activation} | ({"preprocess": preprocess} if preprocess else {})
    module = MODULES[name](kind.actions, kind.size, **options)
    batch = rollout(kind, np.random.default_rng(0))
    params, state = jax.jit(module.init)(jax.random.key(0), batch.frames[0])
    return IntrinsicModule(*map(jax.jit, module)), params, state, batch


def all_rows(batch):
    return transitions(batch, jnp.arange(batch.action.size))


def test_reward_and_loss_have_their_shapes_and_are_finite(name, kind):
    module, params, state, batch = made(name, kind)
    reward, after = module.reward(params, state, batch, jax.random.key(1))
    assert reward.shape == batch.action.shape
    assert reward.dtype == jnp.float32
    assert np.all(np.asarray(reward) >= 0)
    assert np.all(np.asarray(reward)[np.asarray(batch.valid)] > 0)
    assert np.all(np.asarray(reward)[~np.asarray(batch.valid)] == 0)
    assert jax.tree.structure(after) == jax.tree.structure(state)
    loss, metrics = module.loss(params, state, all_rows(batch), batch, jax.random.key(2))
    assert loss.shape == ()
    for value in (loss, *metrics.values()):
        assert np.isfinite(value)


def test_jit_and_vmap_agree_with_neither(name, kind):
    module, params, state, batch = made(name, kind)
    rows, key = all_rows(batch), jax.random.key(2)
    jitted = module.loss(params, state, rows, batch, key)[0]
    plain = MODULES[name](kind.actions, kind.size).loss(params, state, rows, batch, key)[0]
    np.testing.assert_allclose(jitted, plain, rtol=1e-4)
    two = lambda tree: jax.tree.map(lambda x: jnp.stack([x, x]), tree)
    mapped = jax.vmap(module.loss)(*map(two, (params, state, rows, batch, key)))[0]
    np.testing.assert_allclose(mapped, [plain, plain], rtol=1e-4)
    reward = module.reward(params, state, batch, key)[0]
    mapped = jax.vmap(module.reward)(*map(two, (params, state, batch, key)))[0]
    np.testing.assert_allclose(mapped, [reward, reward], rtol=1e-3, atol=1e-7)


def test_invalid_rows_full_of_garbage_change_nothing(name, kind):
    """Rows of a minibatch: neither the value nor any gradient sees what is not valid."""
    module, params, state, batch = made(name, kind)
    rows, key = all_rows(batch), jax.random.key(2)
    assert not np.all(rows.valid)
    bad = lambda x: jnp.where(
        rows.valid.reshape((-1,) + (1,) * (x.ndim - 1)),
        x,
        jnp.asarray(jnp.nan if jnp.issubdtype(x.dtype, jnp.floating) else 77, x.dtype),
    )
    dirty = rows._replace(
        frame=bad(rows.frame), next_frame=bad(rows.next_frame), action=bad(rows.action)
    )
    gradient = jax.jit(jax.value_and_grad(lambda p, r: module.loss(p, state, r, batch, key)[0]))
    for one, other in zip(
        *(jax.tree.leaves(gradient(params, r)) for r in (rows, dirty)), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_distillation_moves_the_learned_network_and_never_the_target(name, kind):
    module, params, state, batch = made(name, kind)
    rows, key = all_rows(batch), jax.random.key(2)
    distill = lambda p: module.loss(p, state, rows, batch, key)[1]["distillation_loss"]
    gradient = jax.grad(distill)(params)
    assert any(np.any(g) for g in jax.tree.leaves(gradient["learned"]))
    for part in set(params) - {"learned"}:
        assert not any(np.any(g) for g in jax.tree.leaves(gradient[part]))
    if "target" in params:
        shape = lambda p: module.loss(p, state, rows, batch, key)[1]["objective_loss"]
        gradient = jax.grad(shape)(params)
        assert all(np.any(g) for g in jax.tree.leaves(gradient["target"]))
        assert not any(np.any(g) for g in jax.tree.leaves(gradient["learned"]))
    else:
        assert "target" in state  # frozen: no optimizer ever sees it


def test_black_frames_have_finite_gradients(name, kind):
    module, params, state, batch = made(name, kind)
    rows = all_rows(batch._replace(frames=jnp.zeros_like(batch.frames)))
    gradient = jax.grad(lambda p: module.loss(p, state, rows, batch, jax.random.key(0))[0])(params)
    for leaf in jax.tree.leaves(gradient):
        assert np.all(np.isfinite(leaf))


def test_distillation_on_a_fixed_batch_falls(name, kind):
    """Against a target that stays: some steps of the learned network alone."""
    module, params, state, batch = made(name, kind)
    rows, optimizer = all_rows(batch), optax.adam(3e-3)
    rest = {k: v for k, v in params.items() if k != "learned"}

    @jax.jit
    def step(learned, optimizer_state, key):
        loss = lambda p: module.loss(rest | {"learned": p}, state, rows, batch, key)[1]
        value, gradient = jax.value_and_grad(lambda p: loss(p)["distillation_loss"])(learned)
        updates, optimizer_state = optimizer.update(gradient, optimizer_state)
        return optax.apply_updates(learned, updates), optimizer_state, value

    learned, optimizer_state = params["learned"], optimizer.init(params["learned"])
    values = []
    steps = 400 if kind.name == "vector" else 40
    for key in jax.random.split(jax.random.key(0), steps):
        learned, optimizer_state, value = step(learned, optimizer_state, key)
        values.append(float(value))
    assert np.mean(values[-5:]) < 0.5 * np.mean(values[:5])


def test_a_state_seen_often_is_less_novel_than_one_never_seen(name, kind):
    module, params, state, batch = made(name, kind)
    seen, optimizer = all_rows(batch), optax.adam(3e-3)

    @jax.jit
    def step(params, optimizer_state, key):
        gradient = jax.grad(lambda p: module.loss(p, state, seen, batch, key)[0])(params)
        updates, optimizer_state = optimizer.update(gradient, optimizer_state)
        return optax.apply_updates(params, updates), optimizer_state

    optimizer_state = optimizer.init(params)
    steps = 1000 if kind.name == "vector" else 150
    for key in jax.random.split(jax.random.key(1), steps):
        params, optimizer_state = step(params, optimizer_state, key)
    other = rollout(kind, np.random.default_rng(99))
    novelty = lambda r: module.reward(params, state, r, key)[0][np.asarray(r.valid)].mean()
    assert novelty(other) > 1.5 * novelty(batch)


def test_activations_and_preprocessings_are_options(name, kind):
    for options in ({"activation": "published"}, {"preprocess": "standardize"}):
        module, params, state, batch = made(name, kind, **options)
        reward, _ = module.reward(params, state, batch, jax.random.key(1))
        assert np.all(np.isfinite(reward))
