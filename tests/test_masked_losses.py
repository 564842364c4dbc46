"""Put NaN into the invalid rows of every public loss: value and gradient must not notice."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sndjax
from sndjax import ppo

B, D, A = 6, 4, 3
VALID = jnp.array([True, False, True, True, False, True])
KEY = jax.random.key(0)


def local(z):
    return z.reshape(B, 1, 1, D)


def ppo_loss(logits, value, old, advantage, target, action, valid):
    hyper = sndjax.Hyperparameters()
    return ppo.loss(logits, value, action, old[:, 0], advantage[:, 0], target, valid, hyper)[0]


# Each takes float rows, the actions and the mask.
LOSSES = {
    "vicreg": (2, lambda z, y, action, valid: sndjax.vicreg_loss(z, y, valid)[0]),
    "barlow_twins": (2, lambda z, y, action, valid: sndjax.barlow_twins_loss(z, y, valid)[0]),
    "byol": (2, lambda z, y, action, valid: sndjax.byol_distance(z, y, valid)),
    "st_dim": (
        4,
        lambda a, b, c, z, action, valid: sndjax.st_dim_loss(
            local(a), local(b), c, z, valid, spread_weight=0.1
        )[0],
    ),
    "prediction": (2, lambda z, y, action, valid: sndjax.prediction_loss(z, y, valid)),
    "distillation": (
        2,
        lambda z, y, action, valid: sndjax.distillation_loss(z, y, valid, KEY, 0.5),
    ),
    "inverse_dynamics": (
        1,
        lambda z, action, valid: sndjax.inverse_dynamics_loss(z[:, :A], action, valid)[0],
    ),
    "ppo": (5, lambda *rows: ppo_loss(rows[0][:, :A], *rows[1:])),
    "masked_mean": (1, lambda z, action, valid: jnp.sum(sndjax.masked_mean(z**2, valid))),
}


def rows(count, fill):
    """Return float rows and actions, with `fill` and an impossible action in the invalid ones."""
    rng = np.random.default_rng(0)
    wrong = ~np.asarray(VALID)
    floats = [rng.normal(size=(B, D)).astype(np.float32) for _ in range(count)]
    for x in floats:
        x[wrong] = fill
    action = rng.integers(0, A, B).astype(np.int32)
    action[wrong] = 77 if np.isnan(fill) else 0
    return tuple(map(jnp.asarray, floats)), jnp.asarray(action)


@pytest.mark.parametrize("name", [name for name in LOSSES if name != "masked_mean"])
def test_loss_nan_in_invalid_rows_changes_neither_value_nor_gradient(name):
    count, loss = LOSSES[name]
    graded = jax.value_and_grad(lambda floats, action: loss(*floats, action, VALID))
    clean, wanted = graded(*rows(count, 0.0))
    dirty, got = graded(*rows(count, np.nan))
    assert clean == dirty
    assert np.isfinite(clean)
    for one, other in zip(got, wanted, strict=True):
        np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(np.asarray(one)[~np.asarray(VALID)], 0)
    assert any(np.any(np.asarray(x) != 0) for x in got)


def test_loss_square_of_nan_before_the_mask_would_be_nan():
    """The reason for all this, and proof that the test above can fail."""
    count, loss = LOSSES["masked_mean"]
    gradient = jax.grad(lambda z: loss(z, None, VALID))(rows(count, np.nan)[0][0])
    assert np.isnan(gradient).any()
