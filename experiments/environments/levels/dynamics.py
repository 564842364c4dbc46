"""The rules of MiniGrid for one level, in jax: a step is a few numbers changed in a flat grid."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .fixed_level import (
    BOX,
    CLOSED,
    COLOUR,
    CONTENTS,
    DOOR,
    EMPTY,
    FLOOR,
    GOAL,
    KEY,
    LAVA,
    LOCKED,
    OPEN,
    PORTABLE,
    STATE,
    TARGET,
    Level,
)

LEFT, RIGHT, FORWARD, PICKUP, DROP, TOGGLE = range(6)
NUM_ACTIONS = 6  # MiniGrid's seventh does nothing
STATE_BITS = 3 << STATE


class LevelState(NamedTuple):
    """A running episode.

    Attributes:
      grid: the codes of the cells, row by row.
      position: the agent's cell.
      direction: where it looks: 0 right, 1 down, 2 left, 3 up.
      carrying: the code of what it carries; 0: nothing.
      time: the steps so far.
    """

    grid: Int[Array, " cells"]
    position: Int[Array, ""]
    direction: Int[Array, ""]
    carrying: Int[Array, ""]
    time: Int[Array, ""]


def start_state(level: Level) -> LevelState:
    """Return the state that every episode of a level starts in."""
    row, column = level.start
    number = lambda x: jnp.asarray(x, jnp.int32)
    return LevelState(
        grid=number(level.grid.ravel()),
        position=number(row * level.grid.shape[1] + column),
        direction=number(level.direction),
        carrying=number(0),
        time=number(0),
    )


def toggled(code: Int[Array, ""], carrying: Int[Array, ""]) -> Int[Array, ""]:
    """Return the code of a cell after it was toggled: doors open and close, boxes are opened.

    Args:
      code: of the cell.
      carrying: of what the agent carries; a locked door opens with a key of its colour.
    """
    kind, state, colour = code & 15, (code >> STATE) & 3, (code >> COLOUR) & 7
    has_key = ((carrying & 15) == KEY) & (((carrying >> COLOUR) & 7) == colour)
    turned = jnp.where(
        state == LOCKED, jnp.where(has_key, OPEN, LOCKED), jnp.where(state == OPEN, CLOSED, OPEN)
    )
    door = (code & ~STATE_BITS) | turned << STATE
    inside = code >> CONTENTS
    box = jnp.where(inside == 0, EMPTY, inside)
    return jnp.where(kind == DOOR, door, jnp.where(kind == BOX, box, code))


def step_level(
    level: Level, state: LevelState, action: Int[Array, ""]
) -> tuple[LevelState, Float[Array, ""], Bool[Array, ""], Bool[Array, ""]]:
    """Return the state after an action, the reward, and whether task or limit ended the episode.

    The rules are those of `minigrid.minigrid_env.MiniGridEnv.step`; where the level asks for an
    object, an episode ends when the agent takes it. Success pays 1 - 0.9 * time / max_steps.

    Args:
      level: the level.
      state: before.
      action: 0 left, 1 right, 2 forward, 3 pick up, 4 drop, 5 toggle.
    """
    width = level.grid.shape[1]
    ahead = jnp.array([1, width, -1, -width], jnp.int32)
    front = state.position + ahead[state.direction]
    code = state.grid[front]
    kind, empty_hands = code & 15, state.carrying == 0
    time = state.time + 1

    turn = jnp.where(action == RIGHT, 1, 0) - jnp.where(action == LEFT, 1, 0)
    open_door = (kind == DOOR) & (((code >> STATE) & 3) == OPEN)
    free = jnp.isin(kind, np.array([EMPTY, FLOOR, GOAL, LAVA])) | open_door
    moves = (action == FORWARD) & free
    takes = (action == PICKUP) & jnp.isin(kind, np.array(PORTABLE)) & empty_hands
    drops = (action == DROP) & (code == EMPTY) & ~empty_hands
    toggles = action == TOGGLE

    left = jnp.where(takes, EMPTY, jnp.where(drops, state.carrying, code))
    after = jnp.where(toggles, toggled(code, state.carrying), left)
    asked = ((code >> TARGET) & 1) == 1
    solved = (moves & (kind == GOAL)) | (takes & asked)
    terminated = solved | (moves & (kind == LAVA))
    reward = jnp.where(solved, 1 - 0.9 * time / level.max_steps, 0.0).astype(jnp.float32)
    state = LevelState(
        grid=state.grid.at[front].set(after),
        position=jnp.where(moves, front, state.position),
        direction=(state.direction + turn) % 4,
        carrying=jnp.where(takes, code, jnp.where(drops, 0, state.carrying)),
        time=time,
    )
    return state, reward, terminated, time >= level.max_steps


def count_opened(level: Level, grid: Int[Array, " cells"]) -> Int[Array, ""]:
    """Return how many of a level's doors that were locked at the start are not locked.

    Args:
      level: the level.
      grid: the codes of the cells.
    """
    locked = [cell for cell in level.doors if (level.grid.ravel()[cell] >> STATE) & 3 == LOCKED]
    if not locked:
        return jnp.zeros((), jnp.int32)
    return (((grid[np.array(locked)] >> STATE) & 3) != LOCKED).sum().astype(jnp.int32)


def find_place(level: Level, state: LevelState) -> Int[Array, ""]:
    """Return the number of a state's place: the agent's cell, what it carries, the doors unlocked.

    Args:
      level: the level.
      state: the state.
    """
    kinds = level.portable
    carried = (1 + jnp.arange(len(kinds))) @ (state.carrying == jnp.asarray(kinds))
    cell = jnp.asarray(level.floor_index)[state.position]
    stage = count_opened(level, state.grid) * (1 + len(kinds)) + carried
    return (stage * len(level.floor) + cell).astype(jnp.int32)


def count_places(level: Level) -> int:
    """Return how many numbers `find_place` has; not all of them can be reached."""
    locked = (level.grid >> STATE) & 3 == LOCKED
    doors = int((((level.grid & 15) == DOOR) & locked).sum())
    return (doors + 1) * (1 + len(level.portable)) * len(level.floor)
