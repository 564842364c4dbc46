"""A fixed level as an environment in jax: its rules, a view and perhaps a distractor."""

from typing import Any

import jax.numpy as jnp
import numpy as np

import sndjax

from ...config.validation import unknown_name_error
from ...system.errors import ConfigError
from .distractors import DISTRACTORS
from .dynamics import NUM_ACTIONS, count_opened, count_places, find_place, start_state, step_level
from .fixed_level import Level, load_level
from .views import make_map_view, make_pixel_view

VIEWS = ("map", "pixels")
DRAWN_TILE = 32  # the side of a cell in films


def make_level_environment(level: Level, view: str = "map", tile: int = 4) -> sndjax.JaxEnvironment:
    """Return a level as an environment; its progress is the number of doors that were unlocked.

    Args:
      level: the level.
      view: "map", numbers of 0 and 1, or "pixels", minigrid's picture of all of it.
      tile: the side of a cell in pixels.
    """
    look = make_map_view(level) if view == "map" else make_pixel_view(level, tile)

    def reset(key: Any) -> Any:
        state = start_state(level)
        return state, look(state)

    def step(key: Any, state: Any, action: Any) -> Any:
        state, reward, terminated, truncated = step_level(level, state, action)
        return state, look(state), reward, terminated, truncated

    return sndjax.JaxEnvironment(
        reset,
        step,
        NUM_ACTIONS,
        low=-1 if view == "map" else 0,  # 0 and 1 are then read as they are
        high=1 if view == "map" else 255,
        draw=lambda state: np.asarray(make_pixel_view(level, DRAWN_TILE)(state)),
        place=lambda state: find_place(level, state),
        num_places=count_places(level),
        progress=lambda state: count_opened(level, state.grid).astype(jnp.float32),
    )


def make_level(
    name: str,
    level: int = 0,
    view: str = "map",
    tile: int = 4,
    distractor: str | None = None,
    **options: Any,
) -> sndjax.JaxEnvironment:
    """Return a level of a task of minigrid as an environment.

    Args:
      name: the task's id, such as MiniGrid-DoorKey-16x16-v0, or LockedRooms.
      level: the seed that the task draws the level with.
      view: see `make_level_environment`.
      tile: see there.
      distractor: "television" (new in every step), "sprites" (they move slowly) or "colours" (new
        in every episode); None: none.
      **options: of the task's constructor, such as `max_steps`.

    Raises:
      ConfigError: the task is not known or has rules of its own, or view or distractor is unknown.
    """
    if not isinstance(tile, int) or tile < 1:
        raise ConfigError(f"env.options.tile={tile}: must be a whole number, at least 1")
    if view not in VIEWS:
        raise unknown_name_error("value of env.options.view", view, VIEWS)
    env = make_level_environment(load_level(name, level, **options), view, tile)
    if distractor is None:
        return env
    if distractor not in DISTRACTORS:
        raise unknown_name_error("value of env.options.distractor", distractor, list(DISTRACTORS))
    return DISTRACTORS[distractor](env)
