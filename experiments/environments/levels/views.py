"""What an agent sees of a level: all of it, as numbers or as minigrid's picture."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from .dynamics import LevelState
from .fixed_level import CLOSED, COLOUR, DOOR, LOCKED, OPEN, PORTABLE, STATE, Level

LOOK_BITS = (1 << 9) - 1  # type, colour and state, which is what minigrid draws
View = Callable[[LevelState], Any]


def make_map_view(level: Level) -> View:
    """Return a view of a level as float32 numbers of 0 and 1; what never changes is left out.

    For each cell that is no wall whether the agent is there, and for each kind of object that can
    be carried (key, ball, box) whether one lies there; for each door whether it is open, closed or
    locked; the agent's direction; which object it carries.

    Args:
      level: the level.
    """
    floor, doors = jnp.asarray(level.floor), jnp.asarray(level.doors)
    index, carried = jnp.asarray(level.floor_index), jnp.asarray(level.portable)
    kinds = [kind for kind in PORTABLE if kind in set(level.portable & 15)]

    def view(state: LevelState) -> Float[Array, " numbers"]:
        lying = state.grid[floor] & 15
        door_state = (state.grid[doors] >> STATE) & 3
        parts = [
            jax.nn.one_hot(index[state.position], len(floor)),
            *(lying == kind for kind in kinds),
            jax.nn.one_hot(door_state, 3).ravel(),
            jax.nn.one_hot(state.direction, 4),
            carried == state.carrying,
        ]
        return jnp.concatenate([part.astype(jnp.float32) for part in parts])

    return view


def draw_tiles(level: Level, side: int) -> np.ndarray:
    """Return minigrid's pictures of cells, uint8[512, 5, side, side, 3].

    The first index is a code's type, colour and state; the second 0 for a cell without the agent,
    else 1 + the agent's direction. Codes that no cell of the level can have stay black.

    Args:
      level: the level.
      side: of a cell in pixels.
    """
    from minigrid.core.grid import Grid
    from minigrid.core.world_object import WorldObj

    codes = {1, *(int(code) & LOOK_BITS for code in level.grid.ravel())}
    codes |= {int(code) & LOOK_BITS for code in level.portable}
    codes |= {
        code & ~(3 << STATE) | s << STATE
        for code in codes
        if code & 15 == DOOR
        for s in (OPEN, CLOSED, LOCKED)
    }
    tiles = np.zeros((LOOK_BITS + 1, 5, side, side, 3), np.uint8)
    for code in codes:
        thing = WorldObj.decode(code & 15, (code >> COLOUR) & 7, code >> STATE)
        for direction in (None, 0, 1, 2, 3):
            which = 0 if direction is None else 1 + direction
            tiles[code, which] = Grid.render_tile(thing, direction, tile_size=side)
    return tiles


def make_pixel_view(level: Level, side: int) -> View:
    """Return a view of a level as minigrid draws it, uint8[H * side, W * side, 3].

    What the agent carries is not in that picture; it is drawn over the wall in the upper left
    corner.

    Args:
      level: the level.
      side: of a cell in pixels.
    """
    height, width = level.grid.shape
    tiles = jnp.asarray(draw_tiles(level, side))

    def view(state: LevelState) -> UInt8[Array, "H W 3"]:
        codes = jnp.where(state.carrying > 0, state.grid.at[0].set(state.carrying), state.grid)
        agent = jnp.zeros(height * width, jnp.int32).at[state.position].set(1 + state.direction)
        picture = tiles[codes & LOOK_BITS, agent].reshape(height, width, side, side, 3)
        return picture.transpose(0, 2, 1, 3, 4).reshape(height * side, width * side, 3)

    return view
