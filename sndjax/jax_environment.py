"""An environment that lives in JAX: its two functions, and resets of only those that ended."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Key, PRNGKeyArray, UInt32

from sndjax.protocols import EnvironmentReset, EnvironmentStep

RESETS_OF = 128  # one environment in so many, and at least two, are reset at once
Keys = Key[Array, " N"] | UInt32[Array, "N _"]  # one for each environment


class JaxEnvironment(NamedTuple):
    """An environment as two pure functions of one instance, which is never reset by itself.

    `sndjax` reads only the functions and `num_actions`; the laboratory reads observations by their
    bounds or categories.

    Attributes:
      reset: key -> (state, observation).
      step: (key, state, action) -> (state, observation, reward, terminated, truncated).
      num_actions: A, actions are 0 to A - 1.
      low: the smallest value of each component of an observation, or of all; -inf: no bound.
      high: the largest value.
      categories: for observations whose integers are categories, their number in each component
        (an array that broadcasts to the observation's shape); else None.
      draw: state -> image uint8[H, W, 3], called outside `jax.jit`; None: it cannot be drawn.
      place: state -> int32, the number of the place that a state is in, of which the visited ones
        are counted (`LiveEnvironments.visits`); None: they are not.
      num_places: P, the places are 0 to P - 1.
      progress: state -> float32, how far an episode has come; summed where episodes end. Read only
        with `place`; None: 0.
    """

    reset: EnvironmentReset
    step: EnvironmentStep
    num_actions: int
    low: Any = -jnp.inf
    high: Any = jnp.inf
    categories: Any = None
    draw: Callable[[Any], Any] | None = None
    place: Callable[[Any], Any] | None = None
    num_places: int = 0
    progress: Callable[[Any], Any] | None = None


def check_environment(env: JaxEnvironment) -> None:
    """Check, without computing anything, that `reset` and `step` fit each other.

    Args:
      env: what is checked.

    Raises:
      ValueError: `step` returns a state or an observation of another structure, shape or dtype than
        `reset`, or its reward or a flag is not a scalar; or of `place`, `num_places` and `progress`
        one needs another that is missing.
    """
    if (env.place is None) != (env.num_places == 0) or (env.progress and env.place is None):
        raise ValueError("place needs num_places, num_places and progress need place")
    key = jax.random.key(0)
    state, frame = jax.eval_shape(env.reset, key)
    action = jax.ShapeDtypeStruct((), jnp.int32)
    after, next_frame, *scalars = jax.eval_shape(env.step, key, state, action)
    structure: Callable[[Any], Any] = jax.tree.structure
    for name, old, new in (("state", state, after), ("observation", frame, next_frame)):
        if structure(old) != structure(new):
            raise ValueError(f"step returns a {name} of another structure than reset")
        for (path, was), becomes in zip(
            jax.tree_util.tree_leaves_with_path(old), jax.tree.leaves(new), strict=True
        ):
            if (was.shape, was.dtype) != (becomes.shape, becomes.dtype):
                raise ValueError(
                    f"{name}{jax.tree_util.keystr(path)} is {was.dtype}{list(was.shape)} after "
                    f"reset and {becomes.dtype}{list(becomes.shape)} after step"
                )
    for name, value in zip(("reward", "terminated", "truncated"), scalars, strict=True):
        if jnp.shape(value) != ():
            raise ValueError(f"step returns a {name} of shape {jnp.shape(value)}, not a scalar")


def environment_keys(key: PRNGKeyArray, num_envs: int) -> Keys:
    """Return a key for each environment: the draws of one do not depend on the others."""
    return jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(num_envs))


def is_number(x: Any) -> bool:
    """Return False for arrays of random keys."""
    return not jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def reset_ended(env: JaxEnvironment, ended: Bool[Array, " N"], keys: Keys, live: Any) -> Any:
    """Reset the environments that ended, a few at once, and no others.

    A reset may cost twenty steps (Craftax), and under vmap a branch for each environment would
    become a reset of all of them on every step. The result does not depend on how many are reset at
    once. Under vmap the mapped axes are joined with that of the environments.

    Args:
      env: the environment.
      ended: which are reset.
      keys: the key of each.
      live: state and frame of each, leaves [N, ...].

    Returns:
      `live` with those that ended replaced.
    """

    @custom_vmap
    def reset(ended: Any, keys: Any, live: Any) -> Any:
        count = ended.shape[0]
        some = min(count, max(2, count // RESETS_OF))

        def reset_some(carry: tuple[Array, Any]) -> tuple[Array, Any]:
            left, live = carry
            (index,) = jnp.nonzero(left, size=some, fill_value=count)
            fresh = jax.vmap(env.reset)(keys[jnp.minimum(index, count - 1)])
            put = lambda x, new: x.at[index].set(new, mode="drop")
            return left.at[index].set(False, mode="drop"), jax.tree.map(put, live, fresh)

        return lax.while_loop(lambda carry: jnp.any(carry[0]), reset_some, (ended, live))[1]

    @reset.def_vmap
    def reset_of_all(
        axis_size: int, in_batched: Any, ended: Any, keys: Any, live: Any
    ) -> tuple[Any, Any]:
        """Join the mapped axis with that of the environments, and return the result and its axes.

        Args:
          axis_size: of the mapped axis.
          in_batched: which arguments have it.
          ended: which environments are reset.
          keys: the key of each.
          live: state and frame of each.
        """
        repeat = lambda x, has: x if has else jnp.broadcast_to(x, (axis_size, *x.shape))
        args = jax.tree.map(repeat, (ended, keys, live), tuple(in_batched))
        joined = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), args)
        done = reset(*joined)
        split = lambda x: x.reshape(axis_size, -1, *x.shape[1:])
        return jax.tree.map(split, done), jax.tree.map(lambda _: True, done)

    return reset(ended, keys, live)
