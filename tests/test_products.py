"""Compare rounded products with NumPy's of operands that NumPy rounded."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.agents import batch_for, made
from helpers.rollouts import KINDS

from sndjax import networks, products
from sndjax.convolution import Convolution, convolve

NAMES = {"bfloat16": 7, "tensorfloat32": 10}


def rounded(x, bits):
    """Round float32 to so many bits of mantissa, ties to even, by whole numbers."""
    drop = 23 - bits
    whole = np.asarray(x, np.float32).view(np.uint32).astype(np.uint64)
    up = (1 << (drop - 1)) - 1 + ((whole >> drop) & 1)
    return (((whole + up) >> drop) << drop).astype(np.uint32).view(np.float32)


def operands(seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(5, 7)).astype(np.float32), rng.normal(size=(7, 3)).astype(np.float32)


def test_round_mantissa_bfloat16_equals_that_of_ml_dtypes():
    x = np.random.default_rng(0).normal(size=10_000).astype(np.float32)
    own = np.asarray(products.round_mantissa(jnp.asarray(x), 7))
    np.testing.assert_array_equal(own, x.astype(jnp.bfloat16).astype(np.float32))


@pytest.mark.parametrize(("name", "bits"), NAMES.items())
def test_matmul_value_and_gradients_are_those_of_rounded_operands(name, bits):
    left, right = map(jnp.asarray, operands())
    weights = np.random.default_rng(1).normal(size=(5, 3)).astype(np.float32)
    with jax.default_matmul_precision(name):
        value, back = jax.vjp(products.matmul, left, right)
        d_left, d_right = back(jnp.asarray(weights))
    a, b, g = (rounded(x, bits).astype(np.float64) for x in (left, right, weights))
    np.testing.assert_allclose(value, a @ b, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(d_left, g @ b.T, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(d_right, a.T @ g, rtol=1e-5, atol=1e-6)
    assert np.abs(value - left @ right).max() > 10 ** -(bits / 3)


def test_matmul_without_setting_is_the_product_of_all_bits():
    left, right = map(jnp.asarray, operands())
    np.testing.assert_array_equal(products.matmul(left, right), jnp.matmul(left, right))
    with jax.default_matmul_precision("float32"):
        np.testing.assert_allclose(products.matmul(left, right), left @ right, rtol=1e-5)


def test_round_mantissa_float64_stays():
    with jax.enable_x64(True):
        x = jnp.array([1 / 3])
        assert x.dtype == jnp.float64
        np.testing.assert_array_equal(products.round_mantissa(x, 7), x)


@pytest.mark.parametrize("layer", ["linear", "convolution"])
def test_layers_at_bfloat16_round_their_operands(layer):
    rng = np.random.default_rng(2)
    if layer == "linear":
        x, module = rng.normal(size=(4, 6)).astype(np.float32), networks.linear(3, 1.0)
        params = module.init(jax.random.key(0), x)
        kernel = params["params"]["kernel"]
        run = lambda: module.apply(params, x)
        flat = x
    else:
        x = rng.uniform(size=(4, 2, 2, 6)).astype(np.float32)
        kernel = rng.normal(size=(1, 1, 6, 3)).astype(np.float32)
        layers = (Convolution(3, size=1, padding=0),)
        run = lambda: convolve(jnp.asarray(x), ((jnp.asarray(kernel), jnp.zeros(3)),), layers,
                               "none", (0,))[0]  # fmt: skip
        flat = x.reshape(-1, 6)
    with jax.default_matmul_precision("bfloat16"):
        found = np.asarray(run()).reshape(-1, 3)
    wanted = rounded(flat, 7) @ rounded(np.asarray(kernel).reshape(6, 3), 7)
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)
    assert np.abs(found - np.asarray(run()).reshape(-1, 3)).max() > 1e-4


@pytest.mark.parametrize(
    ("name", "algo", "kind"),
    [
        ("bfloat16", "snd_vic", 2),
        ("tensorfloat32", "sp_vinv", 2),
        pytest.param("bfloat16", "snd_std", 0, marks=pytest.mark.exhaustive),
        pytest.param("tensorfloat32", "snd_std", 1, marks=pytest.mark.exhaustive),
    ],
)
def test_train_step_loss_terms_at_fewer_bits_are_near_those_of_float32(name, algo, kind):
    kind = KINDS[kind]
    _, state, step = made(algo, kind)
    batch = batch_for(kind)
    with jax.default_matmul_precision(name):
        _, rough, _ = step(state, batch)
    _, exact, _ = step(state, batch)
    terms = [key for key in exact if key.endswith("loss") or key.startswith(("vicreg", "st_dim"))]
    assert len(terms) >= 5
    for key in terms:
        np.testing.assert_allclose(rough[key], exact[key], rtol=1e-2, atol=1e-3, err_msg=key)
    assert any(float(rough[key]) != float(exact[key]) for key in terms)
