"""State entropy by nearest neighbours: novel is what few others of the rollout are near to."""

import chex
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from sndjax.protocols import EncoderView, Signal
from sndjax.signals.prediction import encode_rollout
from sndjax.types import Features, Loss, Params, Rollout, State, Transition

SLICE = 512  # rows whose distances to all others exist at once


def neighbour_distance(
    z: Float[Array, "M d"], valid: Bool[Array, " M"], k: int = 3
) -> Float[Array, " M"]:
    """Compute the Euclidean distance of each row to its k-th nearest valid other row.

    Where fewer than k others are valid, the farthest of them; 0 where there is none.

    Args:
      z: features of M rows.
      valid: the rows that count.
      k: which of the nearest.

    >>> neighbour_distance(jnp.array([[0.0], [1.0], [5.0]]), jnp.ones(3, bool), k=1)
    Array([1., 1., 4.], dtype=float32)
    """
    chex.assert_rank([z, valid], [2, 1])
    rows = z.shape[0]
    short = -rows % min(SLICE, rows)
    z = jnp.where(valid[:, None], z, jnp.zeros_like(z))
    # Centred, so that squares are as small as they can be before they are subtracted.
    z = z - jnp.sum(z, axis=0, keepdims=True) / jnp.maximum(jnp.sum(valid), 1).astype(z.dtype)
    squares = jnp.sum(z**2, axis=-1)
    others = jnp.arange(rows)
    k = min(k, rows - 1)
    if k < 1:
        return jnp.zeros(rows, z.dtype)

    def slice_distance(index: Int[Array, " S"]) -> Float[Array, " S"]:
        inner = z[index] @ z.T
        distance = squares[None, :] - 2 * inner  # less the row's own square, the same for all
        candidate = valid[None, :] & (others[None, :] != index[:, None])
        score, nearest = lax.top_k(jnp.where(candidate, -distance, -jnp.inf), k)
        # The product only finds the neighbours: their distances are taken without cancellation.
        exact = jnp.sqrt(jnp.sum((z[index][:, None] - z[nearest]) ** 2, axis=-1))
        return jnp.max(jnp.where(jnp.isfinite(score), exact, jnp.zeros_like(exact)), axis=-1)

    index = jnp.pad(others, (0, short)).reshape(-1, min(SLICE, rows))
    return lax.map(slice_distance, index).reshape(-1)[:rows]


def re3(k: int = 3) -> Signal:
    """Make log(1 + distance of s_t to its k-th nearest neighbour) (eq. 4.46; Seo et al., 2021).

    Neighbours are the valid states of the same rollout. Nothing is trained by the signal;
    the paper's encoder is random and frozen.

    >>> re3()
    re3(k=3)
    """

    def init(
        key: PRNGKeyArray,
        example: Shaped[Array, "N *frame"],
        features: Features,
        num_actions: int,
    ) -> tuple[Params, State]:
        return {}, {}

    def reward(
        params: Params,
        state: State,
        view: EncoderView,
        rollout: Rollout,
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, "T N"], State]:
        z = encode_rollout(view, rollout.frames[:-1])
        distance = neighbour_distance(z.reshape(-1, z.shape[-1]), rollout.valid.reshape(-1), k)
        return jnp.log1p(distance).reshape(rollout.valid.shape), state

    def loss(
        params: Params,
        state: State,
        view: EncoderView,
        features: Features,
        batch: Transition,
        key: PRNGKeyArray,
    ) -> Loss:
        return jnp.zeros((), features.z.dtype), {}

    return Signal(init, reward, loss, has_published_scale=False, name="re3", settings={"k": k})
