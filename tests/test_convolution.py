import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sndjax import convolution
from sndjax.activations import ACTIVATIONS
from sndjax.convolution import Convolution, convolve, convolve_native

LAYERS = {
    "stride 2": (Convolution(4, stride=2),),
    "stride 1": (Convolution(4),),
    "patches": (Convolution(4, 4, 4, 0), Convolution(5, stride=2)),
    "RND": (Convolution(4, 8, 4, 2), Convolution(5, stride=2), Convolution(6)),
    "SND": tuple(Convolution(c, stride=s) for c, s in ((4, 2), (5, 2), (6, 2), (70, 1))),
}
# Indices of the layers whose outputs are asked for, with or without the first layer.
CASES = [
    ("stride 2", (0,)),
    ("stride 1", (0,)),
    ("RND", (2, 2)),
    ("RND", (0, 1)),
    ("SND", (2, 3)),
    ("SND", (1,)),
]


def brute_force(x, kernel, bias, stride, padding):
    """Compute the cross-correlation in float64, one output position at a time."""
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


def network(rng, layers, batch=5, side=12, channels=3):
    """Return frames and the weights of some layers."""
    x = jnp.asarray(rng.normal(size=(batch, side, side, channels)).astype(np.float32))
    weights = []
    for layer in layers:
        shape = (layer.size, layer.size, channels, layer.channels)
        kernel = rng.normal(size=shape) / np.sqrt(layer.size**2 * channels)
        bias = rng.normal(size=layer.channels)
        weights.append(tuple(jnp.asarray(w.astype(np.float32)) for w in (kernel, bias)))
        channels = layer.channels
    return x, tuple(weights)


@pytest.mark.parametrize("lowering", [convolve, convolve_native])
@pytest.mark.parametrize("activation", ["elu", "relu", "none"])
@pytest.mark.parametrize("layers", LAYERS)
def test_convolve_every_layer_output_equals_brute_force(lowering, activation, layers):
    x, weights = network(np.random.default_rng(0), LAYERS[layers])
    wanted = tuple(range(len(weights)))
    maps = lowering(x, weights, LAYERS[layers], activation, wanted)
    for y, (kernel, bias), layer in zip(maps, weights, LAYERS[layers], strict=True):
        x = brute_force(x, kernel, bias, layer.stride, layer.padding)
        x = np.asarray(ACTIVATIONS[activation](jnp.asarray(x.astype(np.float32))))
        np.testing.assert_allclose(y, x, atol=1e-4)


@pytest.mark.parametrize("activation", ["elu", "relu", "none"])
@pytest.mark.parametrize("batch", [1, 8, 19])
@pytest.mark.parametrize(("layers", "wanted"), CASES)
def test_convolve_value_and_gradient_equal_convolve_native(activation, batch, layers, wanted):
    rng = np.random.default_rng(batch)
    layers = LAYERS[layers]
    x, weights = network(rng, layers, batch)
    maps = convolve_native(x, weights, layers, activation, wanted)
    signs = [rng.normal(size=y.shape).astype(np.float32) for y in maps]

    def value(lowering):
        def total(x, weights):
            found = lowering(x, weights, layers, activation, wanted)
            return sum(jnp.sum(s * y**2) for s, y in zip(signs, found, strict=True))

        return jax.jit(jax.value_and_grad(total, (0, 1)))

    got, wanted_ = (jax.tree.leaves(value(f)(x, weights)) for f in (convolve, convolve_native))
    for one, other in zip(got, wanted_, strict=True):
        scale = np.abs(other).max() + 1e-6
        np.testing.assert_allclose(one / scale, other / scale, atol=2e-5)


@pytest.mark.parametrize(
    ("backend", "images", "count"),
    [("cpu", 640, 80), ("cpu", 3, 1), ("cpu", 17, 3), ("gpu", 640, 1), ("gpu", 16_512, 17)],
)
def test_slice_count_by_backend_is_8_images_on_cpu_and_minibatch_on_gpu(
    backend, images, count, monkeypatch
):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    assert convolution.slice_count(images) == count


@pytest.mark.parametrize("slices", [1, 2, 19])
def test_convolve_any_number_of_slices_under_vmap_gives_same_gradients(slices, monkeypatch):
    layers = LAYERS["SND"]
    agents = [network(np.random.default_rng(seed), layers, batch=19) for seed in range(2)]
    total = lambda lowering: lambda x, w: jnp.sum(lowering(x, w, layers, "elu", (2, 3))[1] ** 2)
    wanted = [jax.grad(total(convolve_native), 1)(*agent) for agent in agents]
    monkeypatch.setattr(convolution, "slice_count", lambda images: slices)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *agents)
    found = jax.vmap(jax.grad(total(convolve), 1))(*stacked)
    for one, *others in zip(*map(jax.tree.leaves, (found, *wanted)), strict=True):
        scale = max(np.abs(other).max() for other in others)
        np.testing.assert_allclose(one / scale, np.stack(others) / scale, atol=2e-5)


def test_convolve_uint8_pixels_equal_fractions_of_255():
    rng = np.random.default_rng(0)
    layers = LAYERS["SND"]
    pixels = jnp.asarray(rng.integers(0, 256, (9, 12, 12, 3), dtype=np.uint8))
    _, weights = network(rng, layers)
    floats = pixels / np.float32(255)
    for lowering in (convolve, convolve_native):
        total = lambda w, x: jnp.sum(lowering(x, w, layers, "elu", (3,))[0])  # noqa: B023
        for one, other in zip(
            *(jax.tree.leaves(jax.grad(total)(weights, x)) for x in (pixels, floats)), strict=True
        ):
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4)


def test_convolve_under_vmap_and_in_lax_map_equals_single_calls():
    rng = np.random.default_rng(0)
    layers = LAYERS["SND"]
    parts = [network(rng, layers, batch=11) for _ in range(3)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *parts)
    one = lambda x, w: jnp.sum(convolve(x, w, layers, "elu", (2, 3))[1] ** 2)
    mapped = jax.vmap(jax.grad(one, (0, 1)))(*stacked)
    for i, part in enumerate(parts):
        for got, wanted in zip(
            *(jax.tree.leaves(g) for g in (mapped, jax.grad(one, (0, 1))(*part))), strict=True
        ):
            scale = np.abs(wanted).max()
            np.testing.assert_allclose(got[i] / scale, wanted / scale, atol=2e-5)
    looped = jax.lax.map(lambda p: one(*p), stacked)
    np.testing.assert_allclose(looped, [one(*part) for part in parts], rtol=1e-5)
