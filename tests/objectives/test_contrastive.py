import jax
import jax.numpy as jnp
import numpy as np
from helpers.rollouts import KINDS, rollout
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import Features, contrastive, contrastive_loss, gather_transitions
from sndjax.objectives.contrastive import augment as eager_augment
from sndjax.objectives.contrastive import draw_pairs as eager_draw_pairs

augment = jax.jit(eager_augment)
draw_pairs = jax.jit(eager_draw_pairs, static_argnums=2)


def in_numpy(za, zb, far, bound):
    """Compute the equation in float64, one pair at a time."""
    za, zb = np.asarray(za, np.float64), np.asarray(zb, np.float64)
    pairs = [(float(y) - ((a - b) ** 2).mean()) ** 2 for a, b, y in zip(za, zb, far, strict=True)]
    return np.mean(pairs) + max(0.0, (za**2).mean() + (zb**2).mean() - bound)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.5, 200.0]))
def test_contrastive_loss_random_pairs_equals_equation_in_float64(seed, bound):
    rng = np.random.default_rng(seed)
    za, zb = (jnp.asarray(rng.normal(size=(6, 4)).astype(np.float32)) for _ in range(2))
    far = jnp.asarray(rng.random(6) < 0.5)
    np.testing.assert_allclose(
        contrastive_loss(za, zb, far, bound)[0], in_numpy(za, zb, far, bound), rtol=1e-4
    )


def test_draw_pairs_near_rows_are_equal_far_rows_differ_and_all_are_valid():
    valid = np.random.default_rng(0).random(200) < 0.5
    seen = set()
    for key in jax.random.split(jax.random.key(0), 20):
        one, other, far = map(np.asarray, draw_pairs(key, jnp.asarray(valid), 64))
        assert far.sum() == 32
        assert valid[one].all()
        assert valid[other].all()
        assert np.all((one == other) == ~far)
        seen |= set(one) | set(other)
    assert seen == set(np.flatnonzero(valid))  # every valid row is drawn in one of the 20 calls


def test_draw_pairs_far_rows_are_uniform_over_other_valid_rows():
    valid = jnp.array([True, False, True, True, True])
    one, other, far = map(np.asarray, draw_pairs(jax.random.key(0), valid, 40_000))
    one, other = one[far], other[far]
    for i in (0, 2, 3, 4):
        shares = [np.mean(other[one == i] == j) for j in (0, 2, 3, 4) if j != i]
        np.testing.assert_allclose(shares, 1 / 3, atol=0.03)


def test_draw_pairs_one_or_no_valid_row_gives_equal_rows_in_range():
    for valid in ([False, True, False], [False, False, False]):
        one, other, _ = draw_pairs(jax.random.key(0), jnp.asarray(valid), 8)
        assert np.all(one == other)
        assert np.all((one >= 0) & (one < 3))


def test_augment_images_get_tiles_and_noise_as_published():
    """Half of the samples lose a tenth of their tiles, half get noise in +-0.2."""
    x = jnp.full((400, 24, 24, 1), 0.5)
    for key in jax.random.split(jax.random.key(0), 6):
        y = np.asarray(augment(key, x))[..., 0]
        noisy = np.array([len(np.unique(image)) > 2 for image in y])
        assert abs(noisy.mean() - 0.5) < 0.1
        assert np.abs(y[noisy] - 0.5).min() < 0.2
        assert np.all((y >= -0.2) & (y <= 0.7001))
        plain = y[~noisy]
        assert abs((plain == 0).mean() - 0.5 * 0.1) < 0.03
        holed = np.array([(image == 0).any() for image in plain])
        if tiled(plain, 2) and not tiled(plain, 4):  # so many tiles that each such sample loses one
            assert abs(holed.mean() - 0.5) < 0.15
        # All tiles of a call have the same side, which divides that of the image.
        sides = [s for s in (1, 2, 4, 8, 12) if tiled(plain, s)]
        assert sides
        rest = plain[holed]
        assert np.all((rest == 0) | (rest == 0.5))


def tiled(images, side):
    """Return whether each tile of that side is zero everywhere or nowhere."""
    cut = images.reshape(len(images), 24 // side, side, 24 // side, side) == 0
    return np.all(cut.all((2, 4)) == cut.any((2, 4)))


def test_augment_draws_every_tile_side_and_zeroes_single_elements_of_vectors():
    x = jnp.full((60, 24, 24, 1), 0.5)
    largest = set()
    for key in jax.random.split(jax.random.key(1), 40):
        y = np.asarray(augment(key, x))[..., 0]
        plain = y[[len(np.unique(image)) <= 2 for image in y]]
        largest.add(max(s for s in (1, 2, 4, 8, 12) if tiled(plain, s)))
    assert largest == {1, 2, 4, 8, 12}
    v = np.asarray(augment(jax.random.key(0), jnp.full((2000, 5), 0.5)))
    assert abs((v == 0).mean() - 0.05 * 0.5) < 0.01  # noise hides half of the zeroed elements


def test_contrastive_loss_draws_an_eighth_of_minibatch_from_valid_rows_of_rollout():
    """Each key draws new pairs, never from reset rows, and not from the minibatch only."""
    kind = KINDS[2]
    batch = rollout(kind, np.random.default_rng(0), steps=16, envs=4)
    index = jnp.arange(batch.action.size)
    marked = jnp.broadcast_to(index[:, None].astype(jnp.float32), (64, 5)).reshape(16, 4, 5)
    batch = batch._replace(frames=jnp.concatenate([marked, marked[-1:]]))
    rows = gather_transitions(batch, jnp.arange(48))
    seen = []

    def encode(frames):
        seen.append(np.asarray(frames))
        return frames, None

    for key in jax.random.split(jax.random.key(0), 8):
        contrastive().loss({}, encode, Features(*4 * [None]), rows, batch, key)
    assert all(frames.shape == (6, 5) for frames in seen)
    drawn = {round(float(np.median(row))) for frames in seen for row in frames}
    valid = set(np.flatnonzero(np.asarray(batch.valid)))
    assert drawn <= valid | {0}  # a row with most elements zeroed has median 0
    assert max(drawn) >= 48
    assert len(drawn) > 20


def test_contrastive_loss_rollout_without_valid_rows_trains_on_nothing():
    """Row 0 stands in for the pairs that cannot be drawn; what it holds must not matter."""
    kind = KINDS[2]
    made = rollout(kind, np.random.default_rng(0))
    made = made._replace(frames=made.frames.at[0].set(jnp.nan), valid=jnp.zeros_like(made.valid))
    rows = gather_transitions(made, jnp.arange(16))

    def loss(weight):
        encode = lambda x: (x @ weight, x)
        features = Features(*4 * [None])
        return contrastive().loss({}, encode, features, rows, made, jax.random.key(0))[0]

    value, gradient = jax.value_and_grad(loss)(jnp.ones((5, 4)))
    assert value == 0
    np.testing.assert_array_equal(gradient, 0)
