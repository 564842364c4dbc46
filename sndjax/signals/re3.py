"""State entropy by nearest neighbours: novel is what few others of the rollout are near to."""

import chex
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from sndjax.products import EXACT
from sndjax.protocols import EncoderView, Signal
from sndjax.ranges import Count
from sndjax.signals.prediction import encode_rollout
from sndjax.statistics import (
    init_running_statistics,
    mask_rows,
    masked_mean,
    std,
    update_running_statistics,
)
from sndjax.types import (
    Features,
    Loss,
    Params,
    Rollout,
    RunningStatistics,
    State,
    Transition,
)

SLICE = 512  # rows whose distances to all others exist at once
EXACT_SLICE = 32  # rows whose differences from all others exist at once
# A squared distance below so many roundings of |z|^2 is not told from others by a matrix product.
ROUNDINGS = 1000


def neighbour_distance(
    z: Float[Array, "M d"], valid: Bool[Array, " M"], k: int = 3, average: bool = False
) -> Float[Array, " M"]:
    """Compute the Euclidean distance of each row to its k-th nearest valid other row.

    Where fewer than k others are valid, k is their number; the distance is 0 where there is none.
    Neighbours are found with a matrix product, |a|^2 + |b|^2 - 2 a b, where this tells them from
    others in float32; where it does not, as in tight clusters that are far apart, they are found by
    differences. Distances are computed from differences.

    Args:
      z: features of M rows.
      valid: the rows that count.
      k: which of the nearest.
      average: return the mean distance to the k nearest instead.

    >>> neighbour_distance(jnp.array([[0.0], [1.0], [5.0]]), jnp.ones(3, bool), k=1)
    Array([1., 1., 4.], dtype=float32)
    """
    chex.assert_rank([z, valid], [2, 1])
    rows = z.shape[0]
    k = min(k, rows - 1)
    if k < 1:
        return jnp.zeros(rows, z.dtype)
    z = mask_rows(z, valid)
    # Centred, so that squares are as small as they can be before they are subtracted.
    centred = mask_rows(z - masked_mean(z, valid)[None], valid)
    squares = jnp.sum(centred**2, axis=-1)
    rounding = ROUNDINGS * jnp.finfo(z.dtype).eps
    others = jnp.arange(rows)

    def exact_squares(index: Int[Array, " S"]) -> Float[Array, "S k"]:
        def some(index: Int[Array, " E"]) -> Float[Array, "E k"]:
            squared = jnp.sum((z[index][:, None] - z[None]) ** 2, axis=-1)
            candidate = valid[None, :] & (others[None, :] != index[:, None])
            return -lax.top_k(jnp.where(candidate, -squared, -jnp.inf), k)[0]

        return lax.map(some, index.reshape(-1, EXACT_SLICE)).reshape(-1, k)

    def slice_squares(index: Int[Array, " S"]) -> tuple[Float[Array, "S k"], Bool[Array, ""]]:
        both = jnp.matmul(centred[index], centred.T, precision=EXACT)
        product = squares[None, :] - 2 * both  # less the row's own square
        candidate = valid[None, :] & (others[None, :] != index[:, None])
        score, nearest = lax.top_k(jnp.where(candidate, -product, -jnp.inf), k)
        found = jnp.sum((z[index][:, None] - z[nearest]) ** 2, axis=-1)
        there = jnp.isfinite(score)
        # A neighbour at distance 0 is nearest, however blurred it was.
        blurred = (found > 0) & (found < rounding * (squares[index][:, None] + squares[nearest]))
        # With no more than k others, every one of them is a neighbour.
        choice = jnp.sum(valid) > k + 1
        unsure = choice & jnp.any(blurred & there & valid[index][:, None])
        return jnp.where(there, found, jnp.inf), unsure

    size = min(SLICE, rows + -rows % EXACT_SLICE)
    index = jnp.pad(others, (0, -rows % size)).reshape(-1, size)
    found, unsure = lax.map(slice_squares, index)
    # A loop over the slices that need it: `cond` would search every slice twice under vmap.
    order, count = jnp.argsort(~unsure), jnp.sum(unsure)

    def refine(
        carry: tuple[Int[Array, ""], Float[Array, "P S k"]],
    ) -> tuple[Int[Array, ""], Float[Array, "P S k"]]:
        i, found = carry
        return i + 1, found.at[order[i]].set(exact_squares(index[order[i]]))

    start = (jnp.zeros_like(count), found)
    _, found = lax.while_loop(lambda carry: carry[0] < count, refine, start)
    squared = found.reshape(-1, k)[:rows]
    there = jnp.isfinite(squared)
    distance = jnp.sqrt(jnp.where(there, squared, 0))
    if average:
        return jnp.sum(distance, axis=-1) / jnp.maximum(jnp.sum(there, axis=-1), 1)
    return jnp.max(distance, axis=-1)


def re3(k: Count = 4, *, average: bool = True, normalize: bool = True) -> Signal:
    """Make log(1 + distance of s_t to its nearest neighbours) (eq. 4.46; Seo et al., 2021).

    The defaults are those of the authors' code for MiniGrid: the mean distance to the nearest
    states, over its running standard deviation, without which the reward depends on the scale of
    the features. (The authors average over five, the state itself among them.) Neighbours are the
    valid states of the same rollout. Nothing is trained by the signal; the paper's encoder is
    random and frozen.

    Args:
      k: number of neighbours.
      average: the mean distance to the k nearest; False: the distance to the k-th (eq. 4.46).
      normalize: divide distances by their running standard deviation, this rollout included.

    >>> re3()
    re3(k=4, average=True, normalize=True)
    """

    def init(
        key: PRNGKeyArray,
        example: Shaped[Array, "N *frame"],
        features: Features,
        num_actions: int,
    ) -> tuple[Params, RunningStatistics | None]:
        return {}, init_running_statistics(()) if normalize else None

    def reward(
        params: Params,
        state: RunningStatistics | None,
        view: EncoderView,
        rollout: Rollout,
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, "T N"], RunningStatistics | None]:
        valid = rollout.valid
        z = encode_rollout(view, rollout.frames[:-1])
        rows = z.reshape(-1, z.shape[-1])
        distance = neighbour_distance(rows, valid.reshape(-1), k, average).reshape(valid.shape)
        if state is not None:
            state = update_running_statistics(state, distance, valid)
            distance = distance / std(state)
        return jnp.log1p(distance), state

    def loss(
        params: Params,
        state: State,
        view: EncoderView,
        features: Features,
        batch: Transition,
        key: PRNGKeyArray,
    ) -> Loss:
        return jnp.zeros((), features.z.dtype), {}

    settings = {"k": k, "average": average, "normalize": normalize}
    return Signal(init, reward, loss, has_published_scale=False, name="re3", settings=settings)
