"""The search for a long path through Montezuma's Revenge. Only this file needs ale-py.

The search is the first phase of Go-Explore (Ecoffet et al., 2021): an archive of cells, each with
an emulator state that can be restored, and random actions from these states.
"""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from ..environments.pools import MONTEZUMA_ROOM
from .montezuma_path import ACTION_LETTERS

STATES, ROOMS = 2_700, 12  # states of the thesis' trajectory; rooms that ours should visit
WALK = 100  # agent steps of a random walk from a cell
TRIES = 40  # walks of which one is kept, to lengthen the path at the end
REPEAT = 0.95  # probability that an action is repeated
X, Y, INVENTORY = 42, 43, 65  # bytes of RAM


class Node(NamedTuple):
    """A cell's first visit: the path to it, and the emulator state at that time."""

    parent: int  # index of the parent node; -1 for the start
    actions: bytes  # from the parent
    state: Any
    depth: int  # agent steps from the start
    rooms: frozenset[int]  # visited on the path


class Emulator:
    """The ALE emulator without sticky actions, stepped like the environments."""

    def __init__(self) -> None:
        """Start the game, and step to the first state that an agent sees."""
        from ale_py import Action, ALEInterface, LoggerMode, roms

        ALEInterface.setLoggerMode(LoggerMode.Error)
        self.ale = ALEInterface()
        self.ale.setFloat("repeat_action_probability", 0.0)
        self.ale.setInt("random_seed", 0)
        self.ale.loadROM(cast(Path, roms.get_rom_path("montezuma_revenge")))
        self.legal = [Action(i) for i in range(len(ACTION_LETTERS))]
        self.ale.reset_game()
        self.ale.act(self.legal[0])  # the no-op that `noop_max=1` plays

    def step(self, action: int) -> np.ndarray:
        """Run four emulator frames with an action, and return the RAM."""
        for _ in range(4):
            self.ale.act(self.legal[action])
        return self.ale.getRAM()


def cell_of(ram: np.ndarray) -> tuple[int, ...]:
    """Return the cell of a state: room, coarse position and inventory."""
    return int(ram[MONTEZUMA_ROOM]), int(ram[X]) // 8, int(ram[Y]) // 8, int(ram[INVENTORY])


class Search:
    """The archive of cells and the walks from them."""

    def __init__(self, seed: int):
        """Start with only the first state in the archive."""
        self.draw = np.random.default_rng(seed)
        self.emulator = Emulator()
        ram = self.emulator.ale.getRAM()
        state = self.emulator.ale.cloneState()
        self.nodes = [Node(-1, b"", state, 0, frozenset([int(ram[MONTEZUMA_ROOM])]))]
        self.cells = {cell_of(ram)}
        self.chosen = np.zeros(1 << 17)  # number of walks from each node
        self.reach = np.ones(1 << 17)  # number of rooms on the path to each node

    def walk(self, start: Node) -> Iterator[tuple[bytes, np.ndarray]]:
        """Yield the actions so far and the RAM of a random walk, until its end or a lost life."""
        ale, actions, action = self.emulator.ale, bytearray(), 0
        ale.restoreState(start.state)
        lives = ale.lives()
        for _ in range(min(WALK, STATES - 1 - start.depth)):
            if not actions or self.draw.random() > REPEAT:
                action = int(self.draw.integers(len(ACTION_LETTERS)))
            ram = self.emulator.step(action)
            if ale.lives() < lives or ale.game_over():
                return
            actions.append(action)
            yield bytes(actions), ram

    def explore(self, start: int) -> None:
        """Walk from a cell, and add every new cell to the archive."""
        self.chosen[start] += 1
        parent, before = start, 0
        for actions, ram in self.walk(self.nodes[start]):
            cell = cell_of(ram)
            if cell not in self.cells:
                self.cells.add(cell)
                self.add(parent, actions[before:], cell[0])
                parent, before = len(self.nodes) - 1, len(actions)

    def add(self, parent: int, actions: bytes, room: int) -> None:
        """Add the current emulator state to the archive.

        Args:
          parent: the index of the parent node.
          actions: the actions from the parent.
          room: the current room.
        """
        came = self.nodes[parent]
        depth, rooms = came.depth + len(actions), came.rooms | {room}
        state = self.emulator.ale.cloneState()
        self.reach[len(self.nodes)] = len(rooms)
        self.nodes.append(Node(parent, actions, state, depth, rooms))

    def choose(self) -> int:
        """Draw a node; rarely chosen nodes and nodes with many rooms have more weight."""
        weight = self.reach[: len(self.nodes)] / np.sqrt(self.chosen[: len(self.nodes)] + 1)
        return int(np.searchsorted(np.cumsum(weight), self.draw.random() * weight.sum()))

    def best(self) -> int:
        """Return the node with the most rooms on its path; the deepest if several are equal."""
        reached = [(len(node.rooms), node.depth) for node in self.nodes]
        return max(range(len(reached)), key=reached.__getitem__)

    def lengthen(self) -> int:
        """Extend the best path with the random walk that survives and visits the most cells."""
        ends = [self.best()]
        while ends[0]:
            ends.insert(0, self.nodes[ends[0]].parent)
        while self.nodes[ends[-1]].depth < STATES - 1:
            start, most = self.nodes[ends[-1]], 0
            for _ in range(TRIES):
                steps = list(self.walk(start))
                cells = {cell_of(ram) for _, ram in steps}
                alive = len(steps) == min(WALK, STATES - 1 - start.depth)
                if alive and len(cells) > most:
                    most = len(cells)
                    self.add(ends[-1], steps[-1][0], int(steps[-1][1][MONTEZUMA_ROOM]))
            if most:
                ends.append(len(self.nodes) - 1)
            elif len(ends) > 1:
                ends.pop()  # no walk survives from this node
        return ends[-1]

    def actions(self, node: int) -> bytes:
        """Return all actions from the start to a node."""
        parts = []
        while node >= 0:
            parts.append(self.nodes[node].actions)
            node = self.nodes[node].parent
        return b"".join(reversed(parts))


def search_path(seed: int, deadline: float) -> tuple[int, bytes]:
    """Search for a path until the deadline, or until it visits `ROOMS` rooms.

    Args:
      seed: the seed of the random actions.
      deadline: the time to stop, in seconds as `time.time()` returns them.

    Returns:
      The number of rooms on the path, and its actions.
    """
    search, said = Search(seed), time.time()
    while time.time() < deadline:
        search.explore(search.choose())
        best = search.nodes[search.best()]
        if len(best.rooms) >= ROOMS:
            break
        if time.time() - said > 15:
            said = time.time()
            print(
                f"search {seed}: {len(search.nodes):,} cells, {len(best.rooms)} rooms on the way "
                f"to the best, {best.depth:,} steps; {deadline - said:.0f} s left",
                flush=True,
            )
    end = search.lengthen()
    return len(search.nodes[end].rooms), search.actions(end)
