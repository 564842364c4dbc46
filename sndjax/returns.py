"""Advantages, with reset rows skipped."""

import chex
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float


def generalized_advantage(
    reward: Float[Array, "T N"],
    value: Float[Array, "T1 N"],
    done: Bool[Array, "T N"],
    valid: Bool[Array, "T N"],
    discount: float,
    gae_lambda: float,
    truncated: Bool[Array, "T N"] | None = None,
    episodic: bool = True,
) -> Float[Array, "T N"]:
    """Compute generalized advantage estimates over a rollout that contains reset rows.

    For a valid row t that ends no episode::

        delta_t = r_t + discount * V(s_t+1) - V(s_t)
        A_t     = delta_t + discount * gae_lambda * A_t+1

    and the recursion is cut at the end of an episode, where V(s_t+1) counts as 0.
    (Schulman et al., 2016, "High-dimensional continuous control using GAE", eq. 16.)

    Args:
      reward: r_t, the reward for leaving `frames[t]`.
      value: V(s_t) for the T rows and for the state after the last one.
      done: the episode ended with row t.
      valid: False on reset rows; they are stepped over as if they were not there.
      discount: gamma, in [0, 1].
      gae_lambda: in [0, 1].
      truncated: where given, an episode that a step limit ended is bootstrapped with the
        value of its last observation, `value[t + 1]`, instead of 0.
      episodic: False lets returns run on into the next episode of the same environment, as
        if nothing had ended (Burda et al., 2018, for intrinsic rewards). An episode that ends
        with the last row is then bootstrapped with its own last observation: the next one's
        first has not been seen.

    Returns:
      A_t, 0 on reset rows.

    >>> r, v = jnp.array([[1.0], [1.0]]), jnp.zeros((3, 1))
    >>> no, yes = jnp.zeros((2, 1), bool), jnp.ones((2, 1), bool)
    >>> generalized_advantage(r, v, no, yes, 0.5, 1.0)[:, 0]
    Array([1.5, 1. ], dtype=float32)
    """
    chex.assert_equal_shape([reward, done, valid])
    chex.assert_shape(value, (reward.shape[0] + 1, reward.shape[1]))
    bootstrap = jnp.zeros_like(done) if truncated is None else truncated & done

    def step(
        carry: tuple[Array, Array], row: tuple[Array, ...]
    ) -> tuple[tuple[Array, Array], Array]:
        next_advantage, next_value = carry
        reward, value, value_after, done, valid, bootstrap = row
        if episodic:
            next_advantage = jnp.where(done, 0.0, next_advantage)
            after = jnp.where(done, jnp.where(bootstrap, value_after, 0.0), next_value)
        else:
            after = next_value
        delta = reward + discount * after - value
        advantage = delta + discount * gae_lambda * next_advantage
        carry = (
            jnp.where(valid, advantage, carry[0]),
            jnp.where(valid, value, carry[1]),
        )
        return carry, jnp.where(valid, advantage, 0.0)

    rows = (reward, value[:-1], value[1:], done, valid, bootstrap)
    start = (jnp.zeros_like(value[-1]), value[-1])
    _, advantage = lax.scan(step, start, rows, reverse=True)
    return advantage
