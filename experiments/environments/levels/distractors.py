"""What moves in an observation and has nothing to do with the task.

Each function returns the environment with its observations changed; the rest is as before.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Shaped

import sndjax

SPRITES, SPRITE_SIDE, RING = 3, 4, 8
NUMBERS = SPRITES * RING  # that a vector grows by, whatever the distractor
TELEVISION_ROWS = 8
DISTRACTOR_STREAM = 7  # folded into a step's key
# (key, what moves now, observation) -> (what moves next, the observation with it)
Disturb = Callable[[Any, Any, Any], tuple[Any, Any]]
StartMoving = Callable[[Any], Any]  # key -> what moves in a new episode


def disturb_environment(
    env: sndjax.JaxEnvironment, start: StartMoving, disturb: Disturb
) -> sndjax.JaxEnvironment:
    """Return the environment with something in its observations that moves by itself.

    Args:
      env: the environment.
      start: draws what moves in an episode.
      disturb: moves it, and puts it into an observation.
    """

    def reset(key: Any) -> Any:
        state, seen = env.reset(key)
        key_start, key_move = jax.random.split(jax.random.fold_in(key, DISTRACTOR_STREAM))
        moving, seen = disturb(key_move, start(key_start), seen)
        return (state, moving), seen

    def step(key: Any, state: Any, action: Any) -> Any:
        inner, moving = state
        inner, seen, *rest = env.step(key, inner, action)
        moving, seen = disturb(jax.random.fold_in(key, DISTRACTOR_STREAM), moving, seen)
        return (inner, moving), seen, *rest

    inside = lambda function: function and (lambda state: function(state[0]))
    return env._replace(
        reset=reset,
        step=step,
        draw=inside(env.draw),
        place=inside(env.place),
        progress=inside(env.progress),
    )


def add_television(env: sndjax.JaxEnvironment) -> sndjax.JaxEnvironment:
    """Add noise that is new in every step: 24 numbers of -1 to 1, or 8 rows of pixels below.

    Args:
      env: with observations that are vectors, or images uint8[H, W, 3].
    """

    def disturb(key: Any, moving: Any, seen: Shaped[Array, "..."]) -> tuple[Any, Any]:
        if seen.ndim == 1:
            noise = jax.random.uniform(key, (NUMBERS,), seen.dtype, -1, 1)
        else:
            noise = jax.random.bits(key, (TELEVISION_ROWS, *seen.shape[1:]), jnp.uint8)
        return moving, jnp.concatenate([seen, noise])

    return disturb_environment(env, lambda key: (), disturb)


def start_sprites(key: Any) -> Any:
    """Draw the places, the ways and the colours of the sprites of an episode.

    Returns:
      Places and ways as parts of the image's height and width, float32[3, 2]; uint8[3, 3].
    """
    at, way, colour = jax.random.split(key, 3)
    return (
        jax.random.uniform(at, (SPRITES, 2)),
        jax.random.uniform(way, (SPRITES, 2), minval=-0.1, maxval=0.1),
        jax.random.randint(colour, (SPRITES, 3), 64, 256).astype(jnp.uint8),
    )


def move_sprites(key: Any, moving: Any, seen: Shaped[Array, "H W 3"]) -> tuple[Any, Any]:
    """Move the sprites of an image and draw them.

    Args:
      key: not read: they move straight.
      moving: see `start_sprites`.
      seen: the image.
    """
    at, way, colour = moving
    at = (at + way) % 1
    for i in range(SPRITES):
        rows, columns = (
            ((jnp.arange(length) - jnp.floor(at[i, axis] * length)) % length) < SPRITE_SIDE
            for axis, length in enumerate(seen.shape[:2])
        )
        inside = (rows[:, None] & columns[None])[..., None]
        seen = jnp.where(inside, jnp.maximum(seen, colour[i][None, None]), seen)
    return (at, way, colour), seen


def move_walkers(key: Any, moving: Any, seen: Float[Array, " D"]) -> tuple[Any, Any]:
    """Move walkers on rings of places by one place, to either side, and append where they are.

    Args:
      key: of the steps.
      moving: their places, int32[3].
      seen: the vector.
    """
    ways = jax.random.randint(key, (SPRITES,), 0, 2) * 2 - 1
    moving = (moving + ways) % RING
    return moving, jnp.concatenate([seen, jax.nn.one_hot(moving, RING, dtype=seen.dtype).ravel()])


def add_sprites(env: sndjax.JaxEnvironment) -> sndjax.JaxEnvironment:
    """Add three sprites that move by themselves, slowly, and are elsewhere in each episode.

    To an image squares that cross it and come back at its edges, in colours of the episode: where
    one is, every channel is the larger of its own and the image's. To a vector the places of
    walkers on rings of 8 places, one-hot.

    Args:
      env: with observations that are vectors, or images uint8[H, W, 3].
    """
    if is_vector(env):
        start = lambda key: jax.random.randint(key, (SPRITES,), 0, RING)
        return disturb_environment(env, start, move_walkers)
    return disturb_environment(env, start_sprites, move_sprites)


def change_colours(env: sndjax.JaxEnvironment) -> sndjax.JaxEnvironment:
    """Change what is the same throughout an episode, and has no meaning.

    Each channel of an image gets a black and a white of its own: one of the two is below 96 and the
    other above 160. A vector gets 24 numbers of -1 to 1.

    Args:
      env: with observations that are vectors, or images uint8[H, W, 3].
    """
    if is_vector(env):
        paint = lambda key, moving, seen: (moving, jnp.concatenate([seen, moving]))
        start = lambda key: jax.random.uniform(key, (NUMBERS,), jnp.float32, -1, 1)
        return disturb_environment(env, start, paint)

    def start_colours(key: Any) -> Any:
        dark, bright, swap = jax.random.split(key, 3)
        low = jax.random.uniform(dark, (3,), minval=0, maxval=95)
        high = jax.random.uniform(bright, (3,), minval=160, maxval=255)
        swapped = jax.random.bernoulli(swap, shape=(3,))
        return jnp.where(swapped, high, low), jnp.where(swapped, low, high)

    def disturb(key: Any, moving: Any, seen: Shaped[Array, "H W 3"]) -> tuple[Any, Any]:
        black, white = (x[None, None] for x in moving)
        mixed = black + (white - black) * (seen.astype(jnp.float32) / 255)
        return moving, jnp.rint(mixed).astype(jnp.uint8)

    return disturb_environment(env, start_colours, disturb)


def is_vector(env: sndjax.JaxEnvironment) -> bool:
    """Return True if an environment's observations are vectors."""
    return jax.eval_shape(env.reset, jax.random.key(0))[1].ndim == 1


DISTRACTORS = {
    "television": add_television,
    "sprites": add_sprites,
    "colours": change_colours,
}
