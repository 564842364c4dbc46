import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sndjax.convolution import convolve, convolve_native, convolve_patches

LAYERS = [(3, 2, 1), (3, 1, 1), (8, 4, 2)]  # size, stride, padding


def brute_force(x, kernel, bias, stride, padding):
    """Cross-correlation in float64, one output at a time."""
    x, kernel = np.asarray(x, np.float64), np.asarray(kernel, np.float64)
    x = np.pad(x, ((0, 0), (padding,) * 2, (padding,) * 2, (0, 0)))
    size = kernel.shape[0]
    rows = (x.shape[1] - size) // stride + 1
    columns = (x.shape[2] - size) // stride + 1
    y = np.zeros((len(x), rows, columns, kernel.shape[-1]))
    for i in range(rows):
        for j in range(columns):
            window = x[:, i * stride : i * stride + size, j * stride : j * stride + size]
            y[:, i, j] = np.einsum("bhwc,hwco->bo", window, kernel)
    return y + np.asarray(bias)


def layer(rng, size, batch=5, side=12, channels=3, out=4):
    return (
        jnp.asarray(rng.normal(size=(batch, side, side, channels)).astype(np.float32)),
        jnp.asarray(rng.normal(size=(size, size, channels, out)).astype(np.float32)),
        jnp.asarray(rng.normal(size=out).astype(np.float32)),
    )


@pytest.mark.parametrize("lowering", [convolve_patches, convolve_native, convolve])
@pytest.mark.parametrize(("size", "stride", "padding"), LAYERS)
def test_value_is_the_brute_force_one(lowering, size, stride, padding):
    x, kernel, bias = layer(np.random.default_rng(0), size)
    y = lowering(x, kernel, bias, stride, padding, "none")
    np.testing.assert_allclose(y, brute_force(x, kernel, bias, stride, padding), atol=1e-4)


@pytest.mark.parametrize("activation", ["elu", "relu", "none"])
@pytest.mark.parametrize("batch", [1, 8, 19])
@pytest.mark.parametrize(("size", "stride", "padding"), LAYERS)
def test_patches_equal_native_in_value_and_gradient(activation, batch, size, stride, padding):
    rng = np.random.default_rng(batch)
    args = layer(rng, size, batch)
    weights = rng.normal(size=convolve_native(*args, stride, padding, "none").shape)
    weights = weights.astype(np.float32)

    def value(lowering):
        return lambda *args: jnp.sum(weights * lowering(*args, stride, padding, activation) ** 2)

    for one, other in zip(
        jax.jit(jax.value_and_grad(value(convolve_patches), (0, 1, 2)))(*args)[1],
        jax.value_and_grad(value(convolve_native), (0, 1, 2))(*args)[1],
        strict=True,
    ):
        scale = np.abs(other).max()
        np.testing.assert_allclose(one / scale, other / scale, atol=2e-5)


def test_pixels_are_read_as_fractions_of_255():
    rng = np.random.default_rng(0)
    pixels = jnp.asarray(rng.integers(0, 256, (9, 12, 12, 3), dtype=np.uint8))
    _, kernel, bias = layer(rng, 3)
    for lowering in (convolve_patches, convolve_native):
        gradient = jax.grad(lambda k: jnp.sum(lowering(pixels, k, bias, 2, 1, "elu")))  # noqa: B023
        as_float = jax.grad(
            lambda k: jnp.sum(convolve_native(pixels / np.float32(255), k, bias, 2, 1, "elu"))
        )
        np.testing.assert_allclose(gradient(kernel), as_float(kernel), rtol=1e-4, atol=1e-4)


def test_maps_over_seeds_and_runs_in_a_loop():
    rng = np.random.default_rng(0)
    parts = [layer(rng, 3, batch=11) for _ in range(3)]
    stacked = [jnp.stack(part) for part in zip(*parts, strict=True)]
    one = lambda x, k, b: jnp.sum(convolve_patches(x, k, b, 2, 1, "elu") ** 2)
    mapped = jax.vmap(jax.grad(one, (0, 1, 2)))(*stacked)
    for i, part in enumerate(parts):
        for got, wanted in zip(mapped, jax.grad(one, (0, 1, 2))(*part), strict=True):
            np.testing.assert_allclose(got[i], wanted, rtol=1e-4, atol=1e-3)
    looped = jax.lax.map(lambda p: one(*p), tuple(stacked))
    np.testing.assert_allclose(looped, [one(*part) for part in parts], rtol=1e-5)
