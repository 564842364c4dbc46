"""A level of MiniGrid as arrays: what lies in each cell, where the agent starts, what ends it."""

from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import label

from ...config.envpool_tasks import gym
from ...system.errors import ConfigError
from .locked_rooms import LOCKED_ROOMS, LockedRooms

# Fields of a cell's code: its object's type, colour and state as minigrid numbers them, whether the
# object is the one that the task asks for, and the code of what is in a box.
COLOUR, STATE, TARGET, CONTENTS = 4, 7, 9, 10  # the bit that each starts at; the type's is 0
EMPTY, WALL, FLOOR, DOOR, KEY, BALL, BOX, GOAL, LAVA = range(1, 10)
OPEN, CLOSED, LOCKED = 0, 1, 2
PORTABLE = (KEY, BALL, BOX)
# Tasks that end with the object that they ask for in the agent's hands.
PICKUP_TASKS = ("KeyCorridorEnv", "UnlockPickupEnv", "BlockedUnlockPickupEnv", "ObstructedMazeEnv")


class Level(NamedTuple):
    """A level before the first step; all episodes start like this.

    Attributes:
      grid: int32[H, W], the code of each cell.
      start: the agent's row and column.
      direction: where the agent looks: 0 right, 1 down, 2 left, 3 up.
      max_steps: the steps after which an episode is truncated.
    """

    grid: np.ndarray
    start: tuple[int, int]
    direction: int
    max_steps: int

    @property
    def floor(self) -> np.ndarray:
        """Return the cells that can be reached if every door opens, as indices of the flat grid."""
        joined, _ = label((self.grid & 15) != WALL)
        return np.flatnonzero(joined == joined[self.start])

    @property
    def floor_index(self) -> np.ndarray:
        """Return the number of each cell of `floor` among these, else 0, int32[H * W]."""
        index = np.zeros(self.grid.size, np.int32)
        index[self.floor] = np.arange(len(self.floor))
        return index

    @property
    def doors(self) -> np.ndarray:
        """Return the cells with a door, as indices into the flat grid."""
        return np.flatnonzero((self.grid & 15) == DOOR)

    @property
    def portable(self) -> np.ndarray:
        """Return the codes of the objects that can be carried, boxes' contents too, each once."""
        codes = self.grid.ravel()
        codes = np.concatenate([codes, codes >> CONTENTS])
        return np.unique(codes[np.isin(codes & 15, PORTABLE)])


def encode_object(thing: Any, target: Any = None) -> int:
    """Return the code of an object of minigrid.

    Args:
      thing: the object; None: nothing.
      target: the object that the task asks for, if it asks for one.
    """
    if thing is None:
        return EMPTY
    kind, colour, state = thing.encode()
    code = kind | colour << COLOUR | state << STATE | (thing is target) << TARGET
    contents = thing.contains
    return code | encode_object(contents, target) << CONTENTS if contents else code


def encode_grid(env: Any) -> np.ndarray:
    """Return the cells of a task of minigrid as codes, int32[H, W].

    Args:
      env: the task, after a reset.
    """
    target = getattr(env, "obj", None)
    cells = [encode_object(thing, target) for thing in env.grid.grid]
    return np.array(cells, np.int32).reshape(env.grid.height, env.grid.width)


def make_task(name: str, **options: Any) -> Any:
    """Make a task of minigrid, without gymnasium's wrappers.

    Args:
      name: its id, or "LockedRooms".
      **options: the constructor's.

    Raises:
      ConfigError: it is not known, or it has rules of its own.
    """
    if name == LOCKED_ROOMS:
        return LockedRooms(**options)
    import minigrid
    from minigrid.minigrid_env import MiniGridEnv

    known = [task for task in gym.registry if task.startswith("MiniGrid-")]
    if name not in known:
        from ...config.validation import unknown_name_error

        raise unknown_name_error(f"level of minigrid {minigrid.__version__}", name, known)
    env = gym.make(name, **options).unwrapped
    kind = type(env)
    plain = kind.step is MiniGridEnv.step and kind.__name__ != "PlaygroundEnv"
    bases = {base.__name__ for base in kind.__mro__}
    if not plain and not bases & set(PICKUP_TASKS):
        raise ConfigError(
            f"{name} has rules of its own; levels can be made of tasks with a goal to reach, and "
            "of KeyCorridor, UnlockPickup, BlockedUnlockPickup and ObstructedMaze"
        )
    return env


def load_level(name: str, level: int = 0, **options: Any) -> Level:
    """Return a level of a task of minigrid.

    Args:
      name: the task's id, such as MiniGrid-DoorKey-16x16-v0, or LockedRooms.
      level: the seed that the task draws the level with.
      **options: of the task's constructor, such as `max_steps`.

    Raises:
      ConfigError: the task is not known, or has rules of its own.
    """
    env = make_task(name, **options)
    env.reset(seed=level)
    column, row = env.agent_pos
    found = Level(
        grid=encode_grid(env),
        start=(int(row), int(column)),
        direction=int(env.agent_dir),
        max_steps=int(env.max_steps),
    )
    env.close()
    return found
