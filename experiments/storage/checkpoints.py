"""Checkpoints: written while training continues, the newest and the best kept.

checkpoints/<iteration>/ holds a tree of arrays (`array_trees.py`) and, in its manifest, where the
logs ended.
"""

import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sndjax import TrainState

from ..system.errors import WriteError
from .array_trees import (
    CheckpointError,
    OtherArraysError,
    current_generator,
    other_generator,
    read_manifest,
    read_tree,
    remove_directory,
    verify_manifest,
    write_tree,
)

GENERATOR = "random_generator"  # the entry of the manifest with the name of jax's generator
KEEP = 2  # number of newest checkpoints to keep; the best one is kept too


class Checkpoints:
    """The checkpoints of a run directory, numbered by iteration."""

    def __init__(self, path: Path, writes: bool = True):
        """Set the directory of the checkpoints; `writes` is True on only one of several hosts."""
        self.writes = writes
        self.path = (path / "checkpoints").resolve()
        self.newest: int | None = None  # iteration of the last checkpoint written or restored
        self.writer: threading.Thread | None = None
        self.error: BaseException | None = None

    def steps(self) -> list[int]:
        """Return the iterations that have a checkpoint, in order."""
        if not self.path.is_dir():
            return []
        names = [place.name for place in self.path.iterdir()]
        return sorted(int(name) for name in names if re.fullmatch(r"[0-9]{1,12}", name))

    def save(
        self,
        iteration: int,
        state: TrainState,
        more: dict[str, Any],
        beside: dict[str, Any] | None = None,
    ) -> None:
        """Start an asynchronous write of the current state; only one write runs at a time.

        Args:
          iteration: the number of iterations that the state has completed.
          state: the state; it may be donated as soon as this returns.
          more: further entries of the manifest; `saved_return` reads from it which is the best.
          beside: further trees of arrays by name, such as the environments; see `load_beside`.

        Raises:
          OSError: the previous checkpoint could not be written.
          CheckpointError: the state is that of another iteration.
        """
        self.wait()
        if not self.writes:
            self.newest = iteration
            return
        if np.any(np.asarray(state.iteration) != iteration):
            raise CheckpointError(f"the state is not that of iteration {iteration}")
        tree = jax.tree.map(np.array, unwrap_keys(state._asdict() | (beside or {})))  # a copy
        more = more | {GENERATOR: str(jax.random.key_impl(state.key))}
        self.writer = threading.Thread(
            target=self.write_in_background, args=(iteration, tree, more)
        )
        self.writer.start()

    def write_in_background(self, iteration: int, tree: Any, more: dict[str, Any]) -> None:
        """Write one checkpoint and remove the checkpoints that are no longer needed.

        Args:
          iteration: the number of iterations that the state has completed.
          tree: a copy of the state, as numpy arrays.
          more: further entries of the manifest.
        """
        try:
            write_tree(self.path / str(iteration), tree, {"iteration": iteration} | more)
            self.newest = iteration
            self.prune()
        except Exception as error:  # raised again by `wait`, in the thread that can handle it
            self.error = error

    def wait(self) -> None:
        """Wait until the pending checkpoint is completely on the disk.

        Raises:
          WriteError: the checkpoint could not be written.
        """
        self.join()
        if self.error is not None:
            error, self.error = self.error, None
            cause = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise WriteError(f"a checkpoint: {cause}{self.last_good_message()}") from error

    def join(self) -> None:
        """Wait until no write is running."""
        if self.writer is not None:
            self.writer.join()
            self.writer = None

    def last_good_message(self) -> str:
        """Return the part of an error message that names the last good checkpoint, or ""."""
        return (
            "" if self.newest is None else f"; the checkpoint of iteration {self.newest} is intact"
        )

    def prune(self) -> None:
        """Keep the newest checkpoints and the one with the best return of the last 100 episodes.

        Checkpoints after the last one written belong to iterations that are collected again; they
        are removed.
        """
        assert self.newest is not None
        steps = [step for step in self.steps() if step <= self.newest]
        for step in set(self.steps()) - set(steps):
            remove_directory(self.path / str(step))
        returns = {step: saved_return(self.path / str(step)) for step in steps}
        best = max(steps, key=lambda step: (returns[step], step))
        for step in steps[:-KEEP]:
            if step != best:
                remove_directory(self.path / str(step))

    def find(
        self, fits: Callable[[dict[str, Any]], None]
    ) -> tuple[int | None, dict[str, Any], list[str]]:
        """Find the newest complete checkpoint, with every byte compared with its digest.

        Args:
          fits: a function that raises ValueError if the run's other files do not match a manifest.

        Returns:
          The iteration, the manifest, and a line about each newer checkpoint that cannot be used.
          Without any checkpoint: None, {} and [].

        Raises:
          CheckpointError: there are checkpoints, but none can be used.
        """
        said: list[str] = []
        for step in reversed(self.steps()):
            try:
                manifest = verify_manifest(self.path / str(step), fits)
            except CheckpointError as error:
                said.append(f"checkpoint {step} cannot be used ({error})")
                continue
            self.newest = step
            return step, manifest, said
        if said:
            raise CheckpointError("; ".join(said))
        return None, {}, []

    def load(self, step: int, like: TrainState) -> TrainState:
        """Return the state of one checkpoint.

        Args:
          step: the iteration of the checkpoint.
          like: the shapes and dtypes of the state.

        Raises:
          CheckpointError: the checkpoint is not complete, has other shapes or dtypes, holds another
            iteration, or its random keys are of another generator.
        """
        tree = self.load_tree(step, like)
        if np.any(np.asarray(tree.iteration) != step):
            raise CheckpointError(f"checkpoint {step} holds the state of another iteration")
        return tree

    def load_beside(self, step: int, like: dict[str, Any]) -> dict[str, Any]:
        """Return further trees of a checkpoint by name.

        Args:
          step: the iteration of the checkpoint.
          like: their shapes and dtypes.

        Raises:
          CheckpointError: see `load`.
        """
        return self.load_tree(step, like)

    def load_tree(self, step: int, like: Any) -> Any:
        """Return a tree of one checkpoint with its random keys.

        Args:
          step: the iteration of the checkpoint.
          like: its shapes and dtypes.

        Raises:
          CheckpointError: see `load`.
        """
        try:
            tree, manifest = read_tree(self.path / str(step), unwrapped_shapes(like))
        except OtherArraysError as error:
            raise CheckpointError(
                f"checkpoint {step} is whole, but in this version the algorithm or the task has "
                f"other arrays ({error}); CHANGELOG.md names such changes, and config.yaml the "
                "revision that the run was made with"
            ) from None
        here = current_generator()
        if manifest.get(GENERATOR, here) != here:  # two generators have keys of the same shape
            raise CheckpointError(other_generator(str(manifest[GENERATOR])))
        wrap = lambda old, new: jax.random.wrap_key_data(new) if is_key(old) else new
        return jax.tree.map(wrap, like, tree)


def is_key(leaf: Any) -> bool:
    """Return True for an array of random keys."""
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def unwrap_keys(tree: Any) -> Any:
    """Return a tree with its random keys as plain integers."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if is_key(x) else x, tree)


def unwrapped_shapes(like: Any) -> Any:
    """Return the shapes and dtypes of a tree after `unwrap_keys`."""
    data = jax.random.key_data
    return jax.tree.map(lambda x: jax.eval_shape(data, x) if is_key(x) else x, like)


def saved_return(path: Path) -> float:
    """Return the last-100 return in the manifest of a checkpoint, or -inf."""
    try:
        found = read_manifest(path)["last100"]
    except (CheckpointError, KeyError):
        return -np.inf
    return found if isinstance(found, float) and np.isfinite(found) else -np.inf
