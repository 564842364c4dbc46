"""Rooms in a row, each behind a locked door whose key lies in the room before it."""

from typing import Any

import numpy as np
from minigrid.core.constants import COLOR_NAMES
from minigrid.core.grid import Grid
from minigrid.core.mission import MissionSpace
from minigrid.core.world_object import Door, Goal, Key, Wall
from minigrid.minigrid_env import MiniGridEnv

LOCKED_ROOMS = "LockedRooms"


class LockedRooms(MiniGridEnv):
    """A task of minigrid: the goal is in the last of the rooms, which fill a square to and fro.

    The agent carries one key at a time: to take the next one it drops the last.
    """

    def __init__(self, rooms: int = 4, size: int = 3, max_steps: int | None = None, **kwargs: Any):
        """Set the sizes.

        Args:
          rooms: their number, at least 2.
          size: the side of a room in cells, without its walls.
          max_steps: the steps of an episode; None: 20 for each cell of all rooms.
          **kwargs: of `MiniGridEnv`.

        Raises:
          ValueError: there are fewer than two rooms, or they have no space for a key.
        """
        if rooms < 2 or size < 2:
            raise ValueError(f"rooms={rooms} size={size}: at least two rooms of side 2 are needed")
        self.rooms, self.size = rooms, size
        self.columns = int(np.ceil(np.sqrt(rooms)))
        pitch, rows = size + 1, -(-rooms // self.columns)
        super().__init__(
            mission_space=MissionSpace(mission_func=lambda: "reach the goal"),
            width=self.columns * pitch + 1,
            height=rows * pitch + 1,
            max_steps=20 * rooms * size**2 if max_steps is None else max_steps,
            **kwargs,
        )

    def corner(self, room: int) -> tuple[int, int]:
        """Return the column and the row of a room's first cell, behind its walls."""
        row, column = divmod(room, self.columns)
        if row % 2:
            column = self.columns - 1 - column
        pitch = self.size + 1
        return column * pitch + 1, row * pitch + 1

    def _gen_grid(self, width: int, height: int) -> None:
        self.grid, self.mission = Grid(width, height), "reach the goal"
        for cell in range(width * height):
            self.grid.set(cell % width, cell // width, Wall())
        inside = (self.size, self.size)
        for room in range(self.rooms):
            x, y = self.corner(room)
            for cell in range(self.size**2):
                self.grid.set(x + cell % self.size, y + cell // self.size, None)
        for room in range(self.rooms - 1):
            (x, y), after = self.corner(room), self.corner(room + 1)
            colour = COLOR_NAMES[room % len(COLOR_NAMES)]
            along = self._rand_int(0, self.size)
            right = {1: (x + self.size, y + along), -1: (x - 1, y + along)}
            side = int(np.sign(after[0] - x))
            self.grid.set(
                *right.get(side, (x + along, y + self.size)), Door(colour, is_locked=True)
            )
            self.place_obj(Key(colour), (x, y), inside)
        self.place_obj(Goal(), self.corner(self.rooms - 1), inside)
        self.place_agent(self.corner(0), inside)
