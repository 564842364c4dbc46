"""python -m experiments.trajectory: a long walk through Montezuma's Revenge, without an agent.

Searches for one as Go-Explore's first phase does (Ecoffet et al., 2021): an archive of cells, each
with an emulator state that can be gone back to, and random actions from there. What is kept is the
list of actions, `experiments/data/montezuma.json`; `replayed` makes its frames again. Takes up to
ten minutes; a seed gives the same walk on every machine that gets as far in them.
"""

import hashlib
import json
import os
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from importlib.metadata import version
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from experiments.config import load
from experiments.environments import MONTEZUMA_ROOM, make_pool
from experiments.options import ConfigError
from experiments.process import before_jax
from experiments.run import refuse

DATA = Path(__file__).parent / "data" / "montezuma.json"
STATES, ROOMS = 2_700, 12  # of the thesis' trajectory, and rooms that ours should go through
SEARCH_SECONDS = 480
WALK = 100  # agent steps from a cell
TRIES = 40  # walks of which one is gone on with, at the end
REPEAT = 0.95  # probability that an action is taken once more
X, Y, INVENTORY = 42, 43, 65  # bytes of RAM
LETTERS = "abcdefghijklmnopqr"  # one an action


class Walk(NamedTuple):
    """A trajectory: states s_0 ... s_M-1 and what led from each to the next."""

    frames: np.ndarray  # uint8[M, 96, 96, 1]
    action: np.ndarray  # int32[M - 1]
    room: np.ndarray  # uint8[M - 1], of s_1 ... s_M-1


class Node(NamedTuple):
    """A cell's first visit: how it was come to, and the emulator as it stood then."""

    parent: int  # -1: the start
    actions: bytes  # from there
    state: Any
    depth: int  # agent steps from the start
    rooms: frozenset[int]  # gone through on the way


class Emulator:
    """ALE with a deterministic controller, stepped as the environments are."""

    def __init__(self) -> None:
        """Play to the first state that an agent sees."""
        from ale_py import Action, ALEInterface, LoggerMode, roms

        ALEInterface.setLoggerMode(LoggerMode.Error)
        self.ale = ALEInterface()
        self.ale.setFloat("repeat_action_probability", 0.0)
        self.ale.setInt("random_seed", 0)
        self.ale.loadROM(cast(Path, roms.get_rom_path("montezuma_revenge")))
        self.legal = [Action(i) for i in range(len(LETTERS))]
        self.ale.reset_game()
        self.ale.act(self.legal[0])  # the no-op that `noop_max=1` plays

    def step(self, action: int) -> np.ndarray:
        """The RAM after four emulator frames."""
        for _ in range(4):
            self.ale.act(self.legal[action])
        return self.ale.getRAM()


def cell_of(ram: np.ndarray) -> tuple[int, ...]:
    """What two states must share to be one cell."""
    return int(ram[MONTEZUMA_ROOM]), int(ram[X]) // 8, int(ram[Y]) // 8, int(ram[INVENTORY])


class Search:
    """The archive of cells and the walks from them."""

    def __init__(self, seed: int):
        """Only the start is known."""
        self.draw = np.random.default_rng(seed)
        self.emulator = Emulator()
        ram = self.emulator.ale.getRAM()
        state = self.emulator.ale.cloneState()
        self.nodes = [Node(-1, b"", state, 0, frozenset([int(ram[MONTEZUMA_ROOM])]))]
        self.cells = {cell_of(ram)}
        self.chosen, self.reach = (
            np.zeros(1 << 17),
            np.ones(1 << 17),
        )  # walks from, rooms on the way

    def walk(self, start: Node) -> Iterator[tuple[bytes, np.ndarray]]:
        """Random actions from a cell: those so far and the RAM, until a life is lost."""
        ale, actions, action = self.emulator.ale, bytearray(), 0
        ale.restoreState(start.state)
        lives = ale.lives()
        for _ in range(min(WALK, STATES - 1 - start.depth)):
            if not actions or self.draw.random() > REPEAT:
                action = int(self.draw.integers(len(LETTERS)))
            ram = self.emulator.step(action)
            if ale.lives() < lives or ale.game_over():
                return
            actions.append(action)
            yield bytes(actions), ram

    def explore(self, start: int) -> None:
        """Walk from a cell; every cell that nobody saw before joins the archive."""
        self.chosen[start] += 1
        parent, before = start, 0
        for actions, ram in self.walk(self.nodes[start]):
            cell = cell_of(ram)
            if cell not in self.cells:
                self.cells.add(cell)
                self.add(parent, actions[before:], cell[0])
                parent, before = len(self.nodes) - 1, len(actions)

    def add(self, parent: int, actions: bytes, room: int) -> None:
        """The emulator stands at a new end of a way."""
        came = self.nodes[parent]
        depth, rooms = came.depth + len(actions), came.rooms | {room}
        state = self.emulator.ale.cloneState()
        self.reach[len(self.nodes)] = len(rooms)
        self.nodes.append(Node(parent, actions, state, depth, rooms))

    def choose(self) -> int:
        """A cell, more often one seldom chosen, and one with many rooms on the way to it."""
        weight = self.reach[: len(self.nodes)] / np.sqrt(self.chosen[: len(self.nodes)] + 1)
        return int(np.searchsorted(np.cumsum(weight), self.draw.random() * weight.sum()))

    def best(self) -> int:
        """The cell with the most rooms on the way to it; of those the one farthest away."""
        reached = [(len(node.rooms), node.depth) for node in self.nodes]
        return max(range(len(reached)), key=reached.__getitem__)

    def lengthen(self) -> int:
        """Go on from the best cell to the last state, by walks that end alive and see most."""
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
                ends.pop()  # it was falling already
        return ends[-1]

    def actions(self, node: int) -> bytes:
        """All actions from the start to a cell."""
        parts = []
        while node >= 0:
            parts.append(self.nodes[node].actions)
            node = self.nodes[node].parent
        return b"".join(reversed(parts))


def searched(seed: int, deadline: float) -> tuple[int, bytes]:
    """The number of rooms and the actions that one search found."""
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


def conditions() -> Any:
    """The environment as experiments see it, but for the controller: it does not stick."""
    env = load(["env=MontezumaRevenge", "algo=ppo"]).env
    return replace(env, options={**env.options, "repeat_action_probability": 0.0})


def played(actions: bytes) -> Walk:
    """The frames that an action list leads to, by envpool."""
    pool = make_pool(conditions(), [0], 1)
    frames, rooms = [pool.reset()[0, 0]], []
    for action in actions:
        step = pool.step(np.full((1, 1), action, np.int32))
        assert step.room is not None
        frames.append(step.frame[0, 0])
        rooms.append(step.room[0, 0])
    pool.close()
    taken = np.frombuffer(actions, np.uint8).astype(np.int32)
    return Walk(np.stack(frames), taken, np.array(rooms, np.uint8))


def digest(walk: Walk) -> str:
    """The SHA-256 of its frames."""
    return hashlib.sha256(walk.frames.tobytes()).hexdigest()


def replayed(path: Path = DATA) -> Walk:
    """The committed trajectory.

    Raises:
      ConfigError: its actions lead elsewhere than they did.
    """
    stored = json.loads(path.read_text())
    walk = played(bytes(LETTERS.index(letter) for letter in stored["actions"]))
    if digest(walk) != stored["sha256"]:
        raise ConfigError(
            f"{path.name} leads to other frames than it did with envpool {stored['envpool']}: "
            "search anew with python -m experiments.trajectory"
        )
    return walk


def main(arguments: list[str]) -> int:
    """Search on every core and write the walk through the most rooms."""
    if len(arguments) > 1 or (arguments and arguments[0].startswith("-")):
        print(f"{str(__doc__).strip()}\n\n  python -m experiments.trajectory [FILE]")
        return 0 if arguments[0] in ("-h", "--help") else 2
    path = Path(arguments[0]) if arguments else DATA
    if find_spec("ale_py") is None:
        return refuse("the search needs ale-py: pip install '.[search]'")
    if not os.access(path.parent, os.W_OK):
        return refuse(f"cannot write to {path.parent}")
    deadline, cores = time.time() + SEARCH_SECONDS, os.cpu_count() or 1
    with ProcessPoolExecutor(cores, get_context("spawn")) as pool:
        found = list(pool.map(searched, range(cores), cores * [deadline]))
    rooms, actions = max(found)
    walk = played(actions)
    seen = list(dict.fromkeys(walk.room.tolist()))
    print(f"{len(walk.frames):,} states through {rooms} rooms and more: {seen}")
    path.write_text(
        json.dumps(
            {
                "actions": "".join(LETTERS[action] for action in actions),
                "sha256": digest(walk),
                "rooms": seen,
                "envpool": version("envpool"),
                "ale_py": version("ale-py"),
            },
            indent=1,
        )
        + "\n"
    )
    return 0


if __name__ == "__main__":
    before_jax()
    sys.exit(main(sys.argv[1:]))
