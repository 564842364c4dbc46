"""One suite over every objective x signal x kind of input, at toy size."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from builders import KINDS, frames, rollout

from sndjax import ATARI, PROCGEN, VECTOR, Rollout, grid, transitions
from sndjax.grid import COPYING, OBJECTIVES, SIGNALS

# Signals with a loss of their own, and the name of its metric.
TRAINED = dict.fromkeys(COPYING, "distillation_loss")
TRAINED |= dict.fromkeys(("prediction", "disagreement"), "prediction_loss")
# Every objective with a signal that learns, every signal on VICReg: where a third program
# (float64, vmap) is worth its compilation.
CROSS = [(o, "distillation") for o in OBJECTIVES] + [
    ("vicreg", s) for s in SIGNALS if s != "distillation"
]

pytestmark = pytest.mark.usefixtures("quick_compilation")
every_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
every_cell = pytest.mark.parametrize(
    ("objective", "signal"), [(o, s) for o in OBJECTIVES for s in SIGNALS]
)


class Case(NamedTuple):
    """A cell with its jitted functions, its start and a rollout."""

    module: object
    params: dict
    state: dict
    batch: object
    reward: object
    step: object  # (params, optimizer state, moves, rows, key): one Adam step of chosen parts


@functools.lru_cache(maxsize=1)
def case(objective, signal, kind):
    module = grid(objective, signal, kind.actions, kind.size)
    batch = rollout(kind, np.random.default_rng(0))
    params, state = jax.jit(module.init)(jax.random.key(0), batch.frames[0])
    adam = optax.adam(3e-3)

    @jax.jit
    def step(params, optimizer, moves, rows, key):
        loss = lambda p: module.loss(p, state, rows, batch, key)
        (value, metrics), gradient = jax.value_and_grad(loss, has_aux=True)(params)
        updates, optimizer = adam.update(gradient, optimizer)
        updates = {
            name: jax.tree.map(lambda x, m=moves[name]: m * x, updates[name]) for name in updates
        }
        return value, metrics, gradient, optax.apply_updates(params, updates), optimizer

    return Case(module, params, state, batch, jax.jit(module.reward), step)


def all_rows(batch):
    return transitions(batch, jnp.arange(batch.action.size))


def train(case, rows, moves):
    """Some steps in which the parts that `moves` names learn; the metrics of each."""
    steps = 300 if rows.frame.ndim == 2 else 40  # small perceptrons learn slowly
    moves = {name: jnp.float32(name in moves) for name in case.params}
    params, optimizer, history = case.params, optax.adam(3e-3).init(case.params), []
    for key in jax.random.split(jax.random.key(3), steps):
        _, metrics, _, params, optimizer = case.step(params, optimizer, moves, rows, key)
        history.append(metrics)
    return params, {k: [float(m[k]) for m in history] for k in history[0]}


def one_step(case, rows):
    moves = dict.fromkeys(case.params, jnp.float32(1))
    start = optax.adam(3e-3).init(case.params)
    return case.step(case.params, start, moves, rows, jax.random.key(2))


@functools.cache
def encoder_gradient(objective, kind):
    """The gradient that reaches the encoder where the signal has no loss."""
    return one_step(alone := case(objective, "re3", kind), all_rows(alone.batch))[2]["encoder"]


@every_kind
@every_cell
def test_a_cell(objective, signal, kind):
    made = case(objective, signal, kind)
    batch, rows = made.batch, all_rows(made.batch)
    valid = np.asarray(batch.valid)

    # The reward: shape, dtype, sign; 0 on reset rows; the state keeps its form.
    reward, after = made.reward(made.params, made.state, batch, jax.random.key(1))
    assert reward.shape == batch.action.shape
    assert reward.dtype == jnp.float32
    assert np.all(np.isfinite(reward))
    assert np.all(np.asarray(reward) >= 0)
    assert np.all(np.asarray(reward)[~valid] == 0)
    assert np.any(np.asarray(reward)[valid] > 0)
    assert jax.tree.structure(after) == jax.tree.structure(made.state)
    for old, new in zip(jax.tree.leaves(made.state), jax.tree.leaves(after), strict=True):
        assert (old.shape, old.dtype) == (new.shape, new.dtype)
        assert np.all(np.isfinite(new))

    # The loss: a finite scalar; the same, with its gradients, where rows that do not count
    # hold garbage.
    clean = one_step(made, rows)
    assert clean[0].shape == ()
    assert not np.all(rows.valid)
    bad = lambda x: jnp.where(
        rows.valid.reshape((-1,) + (1,) * (x.ndim - 1)),
        x,
        jnp.asarray(jnp.nan if jnp.issubdtype(x.dtype, jnp.floating) else 77, x.dtype),
    )
    dirty = rows._replace(
        frame=bad(rows.frame), next_frame=bad(rows.next_frame), action=bad(rows.action)
    )
    for one, other in zip(
        *(jax.tree.leaves(x) for x in (clean, one_step(made, dirty))), strict=True
    ):
        assert np.all(np.isfinite(one))
        np.testing.assert_array_equal(one, other)

    # Gradients reach what they should, and nothing else.
    gradient = clean[2]
    moved = lambda tree: [bool(np.any(x)) for x in jax.tree.leaves(tree) if x.ndim > 1]
    assert all(moved(gradient["signal"]))
    assert bool(moved(gradient["signal"])) == (signal in TRAINED)
    if objective == "none":
        assert set(gradient) == {"signal"}
    else:
        assert all(moved(gradient["encoder"]))
        assert all(moved(gradient["objective"]))
        if signal != "prediction":
            other = encoder_gradient(objective, kind)
            for a, b in zip(*map(jax.tree.leaves, (gradient["encoder"], other)), strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)
            made = case(objective, signal, kind)

    # Each loss falls on a fixed batch: the objective's, and the signal's on an encoder that
    # stays where it is.
    if objective != "none":
        _, history = train(made, rows, ("encoder", "objective"))
        values = history["objective_loss"]
        assert np.mean(values[-5:]) < np.mean(values[:5])
    if signal in TRAINED:
        _, history = train(made, rows, ("signal",))
        values = history[TRAINED[signal]]
        assert np.mean(values[-5:]) < 0.9 * np.mean(values[:5])

    a_state_seen_often_is_less_novel_than_one_never_seen(made, signal, kind)


def a_state_seen_often_is_less_novel_than_one_never_seen(made, signal, kind):
    """A thousand looks at one state, and one state among them that was never seen."""
    known, new = frames(np.random.default_rng(5), kind.shape, 2)
    steps, envs = made.batch.action.shape
    still = np.broadcast_to(known, (steps + 1, envs, *kind.shape)).copy()
    no = jnp.zeros((steps, envs), bool)
    calm = made.batch._replace(
        frames=jnp.asarray(still), first=no.at[0].set(True), done=no, valid=~no
    )
    params, _ = train(made, all_rows(calm), ("signal",)) if signal in TRAINED else (made.params, 0)
    _, state = made.reward(params, made.state, calm, jax.random.key(1))
    still[5, 2] = new
    surprise = calm._replace(frames=jnp.asarray(still), first=no)
    reward, _ = made.reward(params, state, surprise, jax.random.key(1))
    # Signals of s_t see it in row 5, signals of s_t+1 in row 4.
    rest = np.delete(np.asarray(reward), 2, axis=1)
    assert np.max(reward[4:6, 2]) > 1.5 * np.max(rest)


@every_kind
@pytest.mark.parametrize(("objective", "signal"), CROSS)
def test_vmap_and_float64_agree(objective, signal, kind):
    made = case(objective, signal, kind)
    rows, key = all_rows(made.batch), jax.random.key(2)
    loss = one_step(made, rows)[0]
    reward = made.reward(made.params, made.state, made.batch, key)[0]

    def both(params, state, batch, rows):
        value, _ = made.module.loss(params, state, rows, batch, key)
        return value, made.module.reward(params, state, batch, key)[0]

    arguments = (made.params, made.state, made.batch, rows)
    two = jax.tree.map(lambda x: jnp.stack([x, x]), arguments)
    values, rewards = jax.jit(jax.vmap(both))(*two)
    np.testing.assert_allclose(values, [loss, loss], rtol=1e-4)
    np.testing.assert_allclose(rewards, [reward, reward], rtol=2e-3, atol=1e-6)
    with jax.enable_x64(True):
        wide = lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x
        value, exact = jax.jit(both)(*jax.tree.map(wide, arguments))
        assert value.dtype == exact.dtype == jnp.float64
    np.testing.assert_allclose(loss, value, rtol=1e-4)
    np.testing.assert_allclose(reward, exact, rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize("size", [ATARI, PROCGEN, VECTOR], ids=["atari", "procgen", "vector"])
@every_cell
def test_full_sizes_have_their_shapes(objective, signal, size):
    """Nothing is computed: shapes and dtypes alone go through every function."""
    shape = {ATARI: (96, 96, 1), PROCGEN: (64, 64, 3), VECTOR: (2,)}[size]
    dtype = jnp.uint8 if len(shape) == 3 else jnp.float32
    steps, envs, actions = 4, 8, 15
    abstract = lambda shape, dtype: jax.ShapeDtypeStruct(shape, dtype)
    flags = abstract((steps, envs), bool)
    module = grid(objective, signal, actions, size)
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
    rows = jax.eval_shape(lambda b: transitions(b, jnp.arange(16)), batch)
    loss, metrics = jax.eval_shape(module.loss, params, state, rows, batch, key)
    for value in (loss, *metrics.values()):
        assert (value.shape, value.dtype) == ((), jnp.float32)
