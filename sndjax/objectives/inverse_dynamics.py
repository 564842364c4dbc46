"""Inverse dynamics: which action led from one state to the next (eq. 5.8)."""

from typing import cast

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sndjax.networks import MLP, mlp_widths
from sndjax.protocols import Encode, Objective
from sndjax.ranges import Positive
from sndjax.statistics import mask_rows, masked_mean
from sndjax.types import Features, Loss, Params, Rollout, Transition


def inverse_dynamics_loss(
    logits: Float[Array, "B A"], action: Int[Array, " B"], valid: Bool[Array, " B"]
) -> Loss:
    """Compute the inverse model's cross-entropy against the chosen action, over n valid rows::

        L = -1/n sum_i log softmax(logits_i)[a_i]                                 (5.8)

    The equation prints d for n; the published VINV puts probabilities where logits belong.

    Args:
      logits: of the inverse model.
      action: the one that the policy chose.
      valid: the rows that count.

    Returns:
      The scalar loss, and the loss with the share of rows whose action was predicted correctly.

    >>> loss, _ = inverse_dynamics_loss(jnp.zeros((2, 4)), jnp.array([0, 3]), jnp.ones(2, bool))
    >>> loss.round(4)
    Array(1.3863, dtype=float32)
    """
    chex.assert_rank([logits, action, valid], [2, 1, 1])
    logits, action = mask_rows(logits, valid), mask_rows(action, valid)
    log_p = jnp.take_along_axis(jax.nn.log_softmax(logits), action[:, None], axis=-1)[:, 0]
    right = (jnp.argmax(logits, axis=-1) == action).astype(logits.dtype)
    loss = masked_mean(-log_p, valid)
    return loss, {"inverse_dynamics": loss, "inverse_accuracy": masked_mean(right, valid)}


def inverse_dynamics(last: Positive = 1.0) -> Objective:
    """Make an inverse model of 2d -> d -> last * d -> A that tells the action from z_t and z_t+1.

    ICM's is `last=1`, SND-VINV's `last=1/2`. See `inverse_dynamics_loss`. Its `init` raises
    ValueError where there are fewer than two actions to tell apart.

    Args:
      last: the width of the last hidden layer, in units of d.

    >>> inverse_dynamics()
    inverse_dynamics(last=1.0)
    """

    def init(key: PRNGKeyArray, features: Features, num_actions: int) -> Params:
        if num_actions < 2:
            raise ValueError(f"inverse dynamics needs at least 2 actions, not {num_actions}")
        width = features.z.shape[-1]
        both = jnp.concatenate([features.z, features.z_next], axis=-1)
        return MLP((width, max(1, int(last * width)), num_actions)).init(key, both)

    def loss(
        params: Params,
        encode: Encode,
        features: Features,
        batch: Transition,
        rollout: Rollout,
        key: PRNGKeyArray,
    ) -> Loss:
        both = jnp.concatenate([features.z, features.z_next], axis=-1)
        logits = cast(Array, MLP(mlp_widths(params)[1:]).apply(params, both))
        return inverse_dynamics_loss(logits, batch.action, batch.valid)

    return Objective(init, loss, name="inverse_dynamics", settings={"last": last})
