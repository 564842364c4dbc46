"""Tests of every objective x signal x kind of input, at toy size.

Most of their time is compilation, so `make test` runs every objective with distillation and every
signal with VICReg; `make test-all` runs every cell.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers.rollouts import KINDS, frames, rollout

from sndjax import (
    ATARI,
    PROCGEN,
    VECTOR,
    Rollout,
    gather_transitions,
    make_module,
    networks,
    slice_transitions,
)
from sndjax.grid import OBJECTIVES, SIGNALS
from sndjax.networks import convolve  # before it is replaced

# Signals with a loss of their own, and the name of its metric.
TRAINED = dict.fromkeys(("distillation", "noveld", "ngu"), "distillation_loss")
TRAINED |= dict.fromkeys(("prediction", "disagreement"), "prediction_loss")
IMAGES, FLAT = KINDS[:2], KINDS[2]
CROSS = [(o, "distillation") for o in OBJECTIVES]
CROSS += [("vicreg", s) for s in SIGNALS if s != "distillation"]
CELLS = [(o, s) for o in OBJECTIVES for s in SIGNALS]


def parameters(kinds):
    """Return every cell with every kind of input, marked where `make test` omits it."""
    marks = lambda cell, kind: () if kind in kinds and cell in CROSS else pytest.mark.exhaustive
    return [
        pytest.param(*cell, kind, marks=marks(cell, kind), id="-".join((*cell, kind.name)))
        for kind in KINDS
        for cell in CELLS
    ]


pytestmark = pytest.mark.usefixtures("quick_compilation")


class Case(NamedTuple):
    """The module of a cell, its first parameters and state, a rollout and all rows of it."""

    module: object
    params: dict
    state: dict
    batch: object
    rows: object


# Episodes here are too short for ten neighbours, before which nothing is novel.
TOY_OPTIONS = {"ngu": {"neighbours": 2}}


@functools.lru_cache(maxsize=1)
def case(objective, signal, kind):
    options = TOY_OPTIONS.get(signal, {})
    module = make_module(objective, signal, kind.actions, kind.size, signal_options=options)
    batch = rollout(kind, np.random.default_rng(0))
    params, state = jax.jit(module.init)(jax.random.key(0), batch.frames[0])
    return Case(
        module, params, state, batch, gather_transitions(batch, jnp.arange(batch.action.size))
    )


def whole(module):
    """Return one function that computes the reward, the loss and the gradient of a module."""

    def both(params, state, batch, rows):
        loss = lambda p: module.loss(p, state, rows, batch, jax.random.key(2))
        (value, metrics), gradient = jax.value_and_grad(loss, has_aux=True)(params)
        reward, after = module.reward(params, state, batch, jax.random.key(1))
        return value, metrics, gradient, reward, after

    return both


@functools.cache
def encoder_gradient(objective, kind):
    """Return the gradient of the encoder where the signal has no loss of its own."""
    module, params, state, batch, rows = case(objective, "re3", kind)
    loss = lambda p: module.loss(p, state, rows, batch, jax.random.key(2))[0]
    return jax.jit(jax.grad(loss))(params).encoder


def with_garbage(rows):
    """Return the rows with NaN or impossible numbers in the invalid ones."""

    def bad(x):
        valid = jnp.tile(rows.valid, x.shape[0] // rows.valid.shape[0])
        mask = valid.reshape((-1,) + (1,) * (x.ndim - 1))
        return jnp.where(mask, x, jnp.asarray(jnp.nan if x.dtype.kind == "f" else 77, x.dtype))

    return rows._replace(frames=bad(rows.frames), action=bad(rows.action))


@pytest.mark.parametrize(("objective", "signal", "kind"), parameters([FLAT]))
def test_make_module_loss_of_slice_transitions_equals_gather_transitions(objective, signal, kind):
    module, params, state, batch, _ = case(objective, signal, kind)
    envs = batch.action.shape[1]
    start, count = 2 * envs, 5 * envs
    drawn = gather_transitions(batch, jnp.arange(start, start + count))
    shared = slice_transitions(batch, jnp.int32(start), count)
    assert shared.frames.shape[0] == count + envs
    assert not np.all(drawn.valid)
    loss = lambda p, rows: module.loss(p, state, rows, batch, jax.random.key(2))
    graded = jax.jit(jax.value_and_grad(loss, has_aux=True))
    wanted = graded(params, with_garbage(drawn))
    # Frames that no valid row reads, as s_t or as s_t+1, are set to NaN.
    read = np.concatenate([drawn.valid, np.zeros(envs, bool)])
    read |= np.concatenate([np.zeros(envs, bool), drawn.valid])
    assert not np.all(read)
    got = graded(params, shared._replace(frames=jnp.where(read[:, None], shared.frames, jnp.nan)))
    pairs = list(zip(*map(jax.tree.leaves, (got, wanted)), strict=True))
    largest = max(float(jnp.max(jnp.abs(other), initial=0.0)) for _, other in pairs)
    for one, other in pairs:
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5 * largest)


@pytest.mark.parametrize(("objective", "signal", "kind"), parameters(KINDS))
def test_make_module_reward_and_loss_are_finite_masked_and_train_the_right_parts(
    objective, signal, kind
):
    module, params, state, batch, rows = case(objective, signal, kind)
    valid = np.asarray(batch.valid)
    both = jax.jit(whole(module))
    loss, metrics, gradient, reward, after = both(params, state, batch, rows)

    # The reward: shape, dtype, sign; 0 on reset rows; the state keeps its structure.
    assert reward.shape == batch.action.shape
    assert reward.dtype == jnp.float32
    assert np.all(np.isfinite(reward))
    assert np.all(np.asarray(reward) >= 0)
    assert np.all(np.asarray(reward)[~valid] == 0)
    assert np.any(np.asarray(reward)[valid] > 0)
    assert jax.tree.structure(after) == jax.tree.structure(state)
    for old, new in zip(jax.tree.leaves(state), jax.tree.leaves(after), strict=True):
        assert (old.shape, old.dtype) == (new.shape, new.dtype)
        assert np.all(np.isfinite(new))

    # The loss: a finite scalar; equal, with its metrics and gradients, if the invalid rows hold
    # garbage.
    assert loss.shape == ()
    assert not np.all(rows.valid)
    dirty = both(params, state, batch, with_garbage(rows))
    clean = (loss, metrics, gradient)
    for one, other in zip(*map(jax.tree.leaves, (clean, dirty[:3])), strict=True):
        assert np.all(np.isfinite(one))
        np.testing.assert_array_equal(one, other)

    # Gradients reach the trained parts, and no other part.
    moved = lambda tree: [bool(np.any(x)) for x in jax.tree.leaves(tree) if x.ndim > 1]
    assert all(moved(gradient.signal))
    assert bool(moved(gradient.signal)) == (signal in TRAINED)
    if objective == "none":
        assert (gradient.encoder, gradient.objective) == (None, None)
        return
    assert all(moved(gradient.encoder))
    assert all(moved(gradient.objective))
    if signal != "prediction":  # its default trains the encoder, see test_prediction.py
        other = encoder_gradient(objective, kind)
        largest = max(float(jnp.max(jnp.abs(x))) for x in jax.tree.leaves(other))
        for a, b in zip(*map(jax.tree.leaves, (gradient.encoder, other)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4 * largest)


# These signals need more training steps than a copy of a network.
SLOW = ("disagreement", "prediction")


def learner(made, objective, signal):
    """Return a function that trains the named parts of the parameters on some rows."""
    vector = made.rows.frame.ndim == 2
    # SND-V's few pairs make its loss rise before it falls: 0.14, 0.24, 0.03, 0.002 every 30 steps.
    patient = signal in SLOW or objective == "contrastive"
    steps = 150 if vector else 200 if patient else 40
    adam = optax.adam(1.0)
    # The first ten steps and the last ten use the same random keys.
    keys = jax.random.split(jax.random.key(3), 10)[np.arange(steps) % 10]

    @jax.jit
    def learn(rates, rows):
        def step(carry, key):
            params, optimizer = carry
            loss = lambda p: made.module.loss(p, made.state, rows, made.batch, key)
            gradient, metrics = jax.grad(loss, has_aux=True)(params)
            updates, optimizer = adam.update(gradient, optimizer)
            scaled = {
                n: jax.tree.map(lambda x, r=rates[n]: r * x, u)
                for n, u in updates._asdict().items()
            }
            moved = optax.apply_updates(params, updates._replace(**scaled))
            return (moved, optimizer), metrics

        (params, _), history = jax.lax.scan(step, (made.params, adam.init(made.params)), keys)
        return params, history

    def train(rows, *parts):
        image_rate = 3e-3 if parts == ("signal",) and signal not in SLOW else 1e-3
        rate = 1e-2 if vector else image_rate
        return learn({n: jnp.float32(rate * (n in parts)) for n in made.params._fields}, rows)

    return train


def fell(values, share=1.0):
    """Return whether the median of the last ten values is below that of the first ten."""
    return np.median(values[-10:]) < share * np.median(values[:10])


@pytest.fixture
def quick_loops(monkeypatch):
    """Use our convolutions, which in a loop are far faster than the native ones."""
    monkeypatch.setattr(networks, "convolve", convolve)


@pytest.mark.usefixtures("quick_loops")
@pytest.mark.parametrize(("objective", "signal", "kind"), parameters([FLAT]))
def test_make_module_training_lowers_losses_and_reward_of_frequent_states(objective, signal, kind):
    """Train the objective on a fixed batch, and the signal on a fixed encoder.

    Then show one state in all rows, and after that a state that was never seen in one row.
    """
    made = case(objective, signal, kind)
    learn = learner(made, objective, signal)
    if objective != "none":
        assert fell(learn(made.rows, "encoder", "objective")[1]["objective_loss"])
    if signal in TRAINED:
        assert fell(learn(made.rows, "signal")[1][TRAINED[signal]], 0.9)

    known, new = frames(np.random.default_rng(5), kind.shape, 2)
    steps, envs = made.batch.action.shape
    still = np.broadcast_to(known, (steps + 1, envs, *kind.shape)).copy()
    no = jnp.zeros((steps, envs), bool)
    calm = Rollout(
        jnp.asarray(still), jnp.zeros_like(made.batch.action), no.at[0].set(True), no, ~no
    )
    params = made.params
    if signal in TRAINED:
        params, _ = learn(gather_transitions(calm, jnp.arange(steps * envs)), "signal")
    reward = jax.jit(made.module.reward)
    _, state = reward(params, made.state, calm, jax.random.key(1))
    still[5, 2] = new
    surprise = calm._replace(frames=jnp.asarray(still), first=no)
    novelty = np.asarray(reward(params, state, surprise, jax.random.key(1))[0])
    # Signals that read s_t see the new state in row 5, signals that read s_t+1 in row 4.
    assert np.max(novelty[4:6, 2]) > 1.5 * np.max(np.delete(novelty, 2, axis=1))


@pytest.mark.parametrize(("objective", "signal", "kind"), parameters([FLAT]))
def test_make_module_jit_vmap_and_float64_give_equal_loss_and_reward(objective, signal, kind):
    module, *arguments = case(objective, signal, kind)
    function = lambda *x: tuple(whole(module)(*x)[i] for i in (0, 3))
    loss, reward = jax.jit(function)(*arguments)
    two = jax.tree.map(lambda x: jnp.stack([x, x]), arguments)
    values, rewards = jax.jit(jax.vmap(function))(*two)
    np.testing.assert_allclose(values, [loss, loss], rtol=1e-4)
    np.testing.assert_allclose(rewards, [reward, reward], rtol=2e-3, atol=1e-6)
    with jax.enable_x64(True):
        wide = lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x
        value, exact = jax.jit(function)(*jax.tree.map(wide, arguments))
        assert value.dtype == exact.dtype == jnp.float64
    np.testing.assert_allclose(loss, value, rtol=1e-4)
    np.testing.assert_allclose(reward, exact, rtol=2e-3, atol=1e-6)
    if kind is FLAT:
        plain = module.loss(*arguments[:2], arguments[3], arguments[2], jax.random.key(2))[0]
        np.testing.assert_allclose(loss, plain, rtol=1e-4)


@pytest.mark.parametrize(("objective", "signal", "kind"), parameters(IMAGES))
def test_make_module_full_size_has_right_shapes_and_dtypes(objective, signal, kind):
    """Trace every function with shapes and dtypes; no number is computed."""
    size = {"atari": ATARI, "procgen": PROCGEN, "vector": VECTOR}[kind.name]
    shape = {"atari": (96, 96, 1), "procgen": (64, 64, 3), "vector": (2,)}[kind.name]
    dtype = jnp.uint8 if len(shape) == 3 else jnp.float32
    steps, envs, actions = 4, 8, 15
    abstract = lambda shape, dtype: jax.ShapeDtypeStruct(shape, dtype)
    flags = abstract((steps, envs), bool)
    module = make_module(objective, signal, actions, size)
    key = jax.eval_shape(lambda: jax.random.key(0))
    batch = Rollout(
        abstract((steps + 1, envs, *shape), dtype),
        abstract((steps, envs), jnp.int32),
        flags,
        flags,
        flags,
    )
    params, state = jax.eval_shape(module.init, key, abstract((envs, *shape), dtype))
    reward, after = jax.eval_shape(module.reward, params, state, batch, key)
    assert (reward.shape, reward.dtype) == ((steps, envs), jnp.float32)
    assert jax.tree.map(lambda x: x.shape, after) == jax.tree.map(lambda x: x.shape, state)
    rows = jax.eval_shape(lambda b: gather_transitions(b, jnp.arange(16)), batch)
    loss, metrics = jax.eval_shape(module.loss, params, state, rows, batch, key)
    for value in (loss, *metrics.values()):
        assert (value.shape, value.dtype) == ((), jnp.float32)
