"""Compare the readers of observations with loops over axes and with closed forms."""

import tracemalloc

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.config.schema import EnvConfig
from experiments.environments.image_layout import find_layout
from experiments.environments.observations import VectorReader, make_reader
from experiments.system.errors import ConfigError

Box, Dict, Discrete = gym.spaces.Box, gym.spaces.Dict, gym.spaces.Discrete


def reader(space, **how):
    return make_reader(space, EnvConfig(name="x", id="X-v0", **how))


def pixels(*shape, dtype=np.uint8, high=255):
    return Box(0, high, shape, dtype)


@pytest.mark.parametrize(
    ("shape", "axes", "size"),
    [
        ((84, 80), "hw", (84, 80, 1)),
        ((84, 80, 3), "hwc", (84, 80, 3)),
        ((3, 84, 80), "chw", (84, 80, 3)),
        ((4, 84, 80, 3), "shwc", (84, 80, 12)),
        ((2, 3, 84, 80), "schw", (84, 80, 6)),
        ((84, 80, 3, 4), "hwcs", (84, 80, 12)),
        ((17, 84, 80, 3), "shwc", (84, 80, 51)),
        ((64, 64, 64), "hwc", (64, 64, 64)),
        ((40, 32, 32), "hwc", (40, 32, 32)),
    ],
)
def test_ImageReader_read_every_order_of_axes_is_height_width_channels(shape, axes, size):
    made = reader(pixels(*shape))
    assert made.shape == size
    images = np.random.default_rng(0).integers(0, 256, (2, *shape), np.uint8)
    got = made.read(images)
    channels = shape[axes.index("c")] if "c" in axes else 1
    for b, h, w, k in np.random.default_rng(1).integers(0, (2, *size), (200, 4)):
        place = {"h": h, "w": w, "c": k % channels, "s": k // channels}
        assert got[b, h, w, k] == images[(b, *(place[axis] for axis in axes))]
    assert bool(made.doubts) == ("s" in axes)  # a stack is read, and the user is told


@pytest.mark.parametrize(
    ("dtype", "high"), [(np.int32, 255), (np.float32, 255), (np.float32, 1), (np.float64, 1)]
)
def test_ImageReader_read_other_dtypes_are_scaled_by_their_range(dtype, high):
    made = reader(pixels(64, 64, 3, dtype=dtype, high=high))
    assert (made.shape, made.dtype) == ((64, 64, 3), np.uint8)
    wanted = np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3))
    images = (wanted * (high / 255)).astype(dtype)
    np.testing.assert_array_equal(made.read(images), wanted)


def test_make_reader_doubtful_images_are_read_as_vectors_with_a_warning():
    free = Box(-np.inf, np.inf, (64, 64, 3), np.float32)
    both = Dict({"rgb": pixels(48, 40, 3), "speed": Box(-1, 1, (2,), np.float32)})
    for space, hint in ((free, "env.pixel_max=255"), (both, "env.observation=image")):
        made = reader(space)
        assert made.dtype == np.float32
        (doubt,) = made.doubts
        assert hint in doubt
    assert reader(both).shape == (48 * 40 * 3 + 2,)
    assert not reader(Dict({"speed": Box(-1, 1, (2,), np.float32)})).doubts


def test_make_reader_uint8_with_other_bounds_is_a_vector_with_a_hint():
    """Read as x / 255, values of 0 to 10 would all be black."""
    made = reader(pixels(64, 64, 3, high=10))
    assert made.shape == (64 * 64 * 3,)
    np.testing.assert_allclose(made.read(np.full((1, 64, 64, 3), 10, np.uint8)), 1)
    assert "env.observation=image env.pixel_max=10" in made.doubts[0]
    image = reader(pixels(64, 64, 3, high=10), observation="image", pixel_max=10.0)
    np.testing.assert_array_equal(image.read(np.full((1, 64, 64, 3), 10, np.uint8)), 255)
    black = reader(pixels(64, 64, 3, high=1))
    np.testing.assert_array_equal(black.read(np.ones((1, 64, 64, 3), np.uint8)), 255)


def test_make_reader_two_images_are_not_advised_to_be_one():
    made = reader(Dict({"a": pixels(48, 40, 3), "b": pixels(48, 40, 3)}))
    assert len(made.doubts) == 2
    assert all("wrapper" in d and "observation=image" not in d for d in made.doubts)


def test_make_reader_pixel_max_without_an_image_is_refused():
    with pytest.raises(ConfigError, match="not read as an image"):
        reader(Box(-1, 1, (4,), np.float32), pixel_max=128.0)


def test_ImageReader_read_nan_is_refused_and_dark_floats_are_doubted():
    made = reader(pixels(64, 64, 3, dtype=np.float32, high=1))
    with pytest.raises(ValueError, match="not finite"):
        made.read(np.full((1, 64, 64, 3), np.nan, np.float32))
    dark = reader(pixels(64, 64, 3, dtype=np.float32))
    assert not dark.doubts
    for _ in range(2):
        dark.read(np.full((1, 64, 64, 3), 0.9, np.float32))
    assert len(dark.doubts) == 1
    assert "env.pixel_max=1" in dark.doubts[0]
    matrix = reader(Box(0, 1, (60, 40), np.float32))
    assert "env.observation=vector" in matrix.doubts[0]


def test_make_reader_observation_image_reads_the_one_image_alone():
    both = Dict({"speed": Box(-1, 1, (2,), np.float32), "rgb": pixels(48, 40, 3)})
    made = reader(both, observation="image")
    image = np.random.default_rng(0).integers(0, 256, (2, 48, 40, 3), np.uint8)
    np.testing.assert_array_equal(made.read({"speed": np.zeros((2, 2)), "rgb": image}), image)
    free = Box(-np.inf, np.inf, (64, 64, 3), np.float32)
    with pytest.raises(ConfigError, match=r"env\.pixel_max=255"):
        reader(free, observation="image")
    made = reader(free, observation="image", pixel_max=2.0)
    np.testing.assert_array_equal(made.read(np.full((1, 64, 64, 3), 1.0)), 128)
    np.testing.assert_array_equal(made.read(np.full((1, 64, 64, 3), 9.0)), 255)
    small = reader(pixels(10, 10, 3), observation="image")
    assert small.shape == (10, 10, 3)
    with pytest.raises(ConfigError, match="have no images"):
        reader(Box(-1, 1, (5,)), observation="image")
    with pytest.raises(ConfigError, match="have 2 images"):
        reader(Dict({"a": pixels(48, 40, 3), "b": pixels(48, 40, 3)}), observation="image")
    with pytest.raises(ConfigError, match="no view of MiniGrid"):
        reader(pixels(48, 40, 3), observation="cells")


def test_make_reader_observation_vector_flattens_an_image():
    made = reader(pixels(48, 40, 3), observation="vector")
    got = made.read(np.full((1, 48, 40, 3), 255, np.uint8))
    assert got.shape == (1, 48 * 40 * 3)
    np.testing.assert_allclose(got, 1)


def test_VectorReader_dict_observations_are_concatenated():
    space = Dict(
        {
            "b": Box(0, 10, (2,), np.float32),
            "a": Dict({"n": Discrete(3), "m": gym.spaces.MultiBinary(2)}),
            "c": Box(-np.inf, np.inf, (1,), np.float32),
        }
    )
    made = VectorReader(space)
    got = made.read(
        {
            "a": {"n": np.array([2, 0]), "m": np.array([[0, 1], [1, 1]])},
            "b": np.array([[0, 10], [5, 2.5]]),
            "c": np.array([[7.0], [8.0]]),
        }
    )
    wanted = [[-1, 1, -1, -1, 1, -1, 1, 7], [1, 1, 1, -1, -1, 0, -0.5, 8]]
    np.testing.assert_allclose(got, wanted)
    assert made.unbounded == (False,) * 7 + (True,)


def test_VectorReader_component_with_equal_bounds_is_zero_and_not_unbounded():
    low, high = np.array([9.81, 0, -np.inf]), np.array([9.81, 2, np.inf])
    made = VectorReader(Box(low.astype(np.float32), high.astype(np.float32)))
    assert made.unbounded == (False, False, True)
    got = made.read(np.array([[9.81, 2.0, 5.0]], np.float32))
    np.testing.assert_array_equal(got, [[0, 1, 5]])


def test_VectorReader_large_discrete_space_needs_memory_of_its_rows_alone():
    made = VectorReader(Discrete(200_000, start=3))
    tracemalloc.start()
    got = made.read(np.array([3, 200_002]))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 4 * got.nbytes  # an identity matrix would be 160 GB
    np.testing.assert_array_equal(np.argwhere(got == 1), [[0, 0], [1, 199_999]])
    assert np.all(got[got != 1] == -1)


@pytest.mark.parametrize("shape", [(4,), (7, 7, 3), (2, 3, 4, 5, 6), (31, 84, 3)])
def test_find_layout_other_shapes_are_no_images(shape):
    assert find_layout(shape, 32) is None


def spaces_and_values(rng):
    """Yield a space, and a batch of its observations."""
    box = gym.spaces.Box(np.float32([-2, 0, -np.inf]), np.float32([4, 0, np.inf]))
    yield box, np.float32(rng.normal(size=(5, 3)))
    codes = gym.spaces.MultiDiscrete(np.array([[3, 2], [4, 2]]), start=np.array([[0, 1], [0, 0]]))
    yield codes, rng.integers(0, 2, (5, 2, 2)) + codes.start
    yield gym.spaces.Discrete(4, start=2), rng.integers(2, 6, 5)
    yield (
        gym.spaces.Box(0, 255, (3, 40, 32), np.uint8),
        rng.integers(0, 256, (5, 3, 40, 32), "uint8"),
    )
    yield gym.spaces.Box(0, 1, (40, 32), np.float32), rng.random((5, 40, 32), "float32")


@pytest.mark.parametrize("kind", range(5))
def test_read_arrays_of_jax_as_those_of_numpy(kind):
    space, value = list(spaces_and_values(np.random.default_rng(0)))[kind]
    reader = make_reader(space, EnvConfig(name="x", id="x"))
    read = jax.jit(reader.read)(jnp.asarray(value))
    wanted = reader.read(value)
    assert read.shape == wanted.shape == (5, *reader.shape)
    assert read.dtype == wanted.dtype == reader.dtype
    np.testing.assert_allclose(read, wanted, atol=1e-6)


def test_read_MultiDiscrete_is_one_hot_in_each_component():
    space, value = list(spaces_and_values(np.random.default_rng(0)))[1]
    read = make_reader(space, EnvConfig(name="x", id="x")).read(value)
    for row, codes in zip(read, value, strict=True):
        wanted = []
        for i in range(2):
            for j in range(2):
                hot = np.zeros(space.nvec[i, j])
                hot[codes[i, j] - space.start[i, j]] = 1
                wanted += [*hot]
        np.testing.assert_array_equal(row, wanted)
