"""Checkpoints: written while training goes on, whole or not at all, verified before they are read.

checkpoints/<iteration>/arrays.npz     every array by its path in the state; `numpy.load` reads it
checkpoints/<iteration>/manifest.json  its digest, and where the logs stood
"""

import hashlib
import json
import re
import shutil
import threading
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sndjax import TrainState

from ..system.files import fsync_path, temporary_name

KEEP = 2  # the newest checkpoints that stay; the best one stays beside them
MANIFEST = "manifest.json"
ARRAYS = "arrays.npz"


class CheckpointError(Exception):
    """What stands on the disk is not what was written, or does not fit."""


class Checkpoints:
    """The checkpoints of a run directory, numbered by iteration."""

    def __init__(self, path: Path, writes: bool = True):
        """Nothing is written yet; of several hosts one writes."""
        self.writes = writes
        self.path = (path / "checkpoints").resolve()
        self.newest: int | None = None  # iteration of the last one written or restored
        self.writer: threading.Thread | None = None
        self.error: BaseException | None = None

    def steps(self) -> list[int]:
        """The iterations that have a checkpoint, in order."""
        if not self.path.is_dir():
            return []
        names = [place.name for place in self.path.iterdir()]
        return sorted(int(name) for name in names if re.fullmatch(r"[0-9]{1,12}", name))

    def save(self, iteration: int, state: TrainState, more: dict[str, Any]) -> None:
        """Begin to write the state, as it is now; one is written at a time.

        Args:
          iteration: how many the state has seen.
          state: it may be donated as soon as this returns.
          more: what else the manifest holds; `saved_return` decides which is the best.

        Raises:
          OSError: the one before could not be written.
        """
        self.wait()
        if not self.writes:
            self.newest = iteration
            return
        tree = jax.tree.map(np.array, unwrap_key(state))  # a copy: the buffers will be used again
        self.writer = threading.Thread(
            target=self.write_in_background, args=(iteration, tree, more)
        )
        self.writer.start()

    def write_in_background(self, iteration: int, tree: Any, more: dict[str, Any]) -> None:
        """Write one and remove what it makes superfluous."""
        try:
            write_tree(self.path / str(iteration), tree, {"iteration": iteration} | more)
            self.newest = iteration
            self.prune()
        except Exception as error:  # raised again by `wait`, in the thread that can answer it
            self.error = error

    def wait(self) -> None:
        """Return when the one that is being written is whole on the disk.

        Raises:
          OSError: it could not be written.
        """
        self.join()
        if self.error is not None:
            error, self.error = self.error, None
            cause = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise OSError(f"a checkpoint: {cause}{self.last_good_message()}") from error

    def join(self) -> None:
        """Return when nothing is being written."""
        if self.writer is not None:
            self.writer.join()
            self.writer = None

    def last_good_message(self) -> str:
        """The last good one, in words."""
        return (
            "" if self.newest is None else f"; the checkpoint of iteration {self.newest} is intact"
        )

    def prune(self) -> None:
        """Keep the newest, and of all the one with the best return of the last 100 episodes.

        Any beyond the newest is of a future that is being collected again.
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
        """The newest checkpoint that is whole, every byte compared with its digest.

        Args:
          fits: raises ValueError where the run's other files are not those of a manifest.

        Returns:
          Its iteration, its manifest, and a line about each newer one that cannot be used. With
          no checkpoint at all: None, nothing, no line.

        Raises:
          Damaged: there are some, and none can be used.
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
        """The state of one checkpoint.

        Args:
          step: its iteration.
          like: the state's shapes and dtypes.

        Raises:
          Damaged: it is not whole, not of these shapes, or of another iteration.
        """
        tree, _ = read_tree(self.path / str(step), unwrapped_shapes(like))
        if np.any(np.asarray(tree.iteration) != step):
            raise CheckpointError(f"checkpoint {step} holds the state of another iteration")
        return tree._replace(key=jax.random.wrap_key_data(tree.key))


def unwrap_key(state: TrainState) -> TrainState:
    """The state with its key as plain integers."""
    return state._replace(key=jax.random.key_data(state.key))


def unwrapped_shapes(like: TrainState) -> Any:
    """The shapes and dtypes of a raw state."""
    return jax.eval_shape(unwrap_key, like)


def saved_return(path: Path) -> float:
    """The return that a checkpoint was written at, or -inf."""
    try:
        found = read_manifest(path)["last100"]
    except (CheckpointError, KeyError):
        return -np.inf
    return found if isinstance(found, float) and np.isfinite(found) else -np.inf


def write_tree(path: Path, tree: Any, manifest: dict[str, Any]) -> None:
    """Write a tree of arrays so that it stands at `path` whole or not at all.

    Raises:
      OSError: the disk is full, say; nothing is left of it.
    """
    new = path.with_name(temporary_name(path.name))
    try:
        remove_directory(new)
        new.mkdir(parents=True)
        with zipfile.ZipFile(new / ARRAYS, "w") as archive:
            for name, value in named_leaves(tree):
                with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, value, allow_pickle=False)
        body = json.dumps(manifest | {"arrays": file_digest(new / ARRAYS)}, sort_keys=True)
        seal = hashlib.sha256(body.encode()).hexdigest()
        (new / MANIFEST).write_text(f'{{"sha256": "{seal}", {body[1:]}')
        for place in (*new.rglob("*"), new):
            fsync_path(place)
        remove_directory(path)  # of the same iteration, damaged
        new.rename(path)
        for place in (path.parent, path.parent.parent):  # whose names are on the disk with it
            fsync_path(place)
    except BaseException:
        remove_directory(new)
        raise


def read_manifest(path: Path) -> dict[str, Any]:
    """The manifest of what stands at `path`, as it was written.

    Raises:
      Damaged: it is not.
    """
    try:
        manifest = json.loads((path / MANIFEST).read_text())
        seal = manifest.pop("sha256")
    except OSError as error:
        raise CheckpointError(f"{MANIFEST}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise CheckpointError(f"{MANIFEST} is not what was written") from None
    if hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest() != seal:
        raise CheckpointError(f"{MANIFEST} is not what was written")
    return manifest


def verify_manifest(
    path: Path, fits: Callable[[dict[str, Any]], None] = lambda manifest: None
) -> dict[str, Any]:
    """The manifest at `path`, after every byte of the arrays was compared with their digest.

    Raises:
      Damaged: in a few words, what is wrong.
    """
    manifest = read_manifest(path)
    try:
        if file_digest(path / ARRAYS) != manifest["arrays"]:
            raise CheckpointError(f"{ARRAYS} is not what was written")
        fits(manifest)
    except FileNotFoundError as error:
        raise CheckpointError(f"{Path(error.filename).name} is missing") from None
    except KeyError as error:
        raise CheckpointError(f"{MANIFEST} says nothing of {error}") from None
    except CheckpointError:
        raise
    except Exception as error:  # what a manifest from elsewhere leads to is open
        raise CheckpointError(str(error) or type(error).__name__) from None
    return manifest


def read_tree(path: Path, like: Any) -> tuple[Any, dict[str, Any]]:
    """The tree at `path` and its manifest.

    Raises:
      Damaged: it is not what was written, or not of the shapes of `like`.
    """
    manifest = verify_manifest(path)
    try:
        with np.load(path / ARRAYS, allow_pickle=False) as archive:
            found = dict(archive)
    except Exception as error:  # what a digest does not show is written elsewhere
        raise CheckpointError(f"{ARRAYS}: {str(error) or type(error).__name__}") from None
    leaves = []
    for name, wanted in named_leaves(like):
        if describe_array(found.get(name)) != describe_array(wanted):
            raise CheckpointError(
                f"{name} is {describe_array(found.get(name))}, not {describe_array(wanted)}"
            )
        leaves.append(found[name])
    return jax.tree.unflatten(jax.tree.structure(like), leaves), manifest


def named_leaves(tree: Any) -> list[tuple[str, Any]]:
    """Every array of a tree with its path, such as params/ppo/torso/kernel."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return [(jax.tree_util.keystr(path, simple=True, separator="/"), x) for path, x in leaves]


def describe_array(array: Any) -> str:
    """The dtype and the shape of an array, or of the want of one."""
    return "none" if array is None else f"{array.dtype}{list(array.shape)}"


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def remove_directory(path: Path) -> None:
    """Remove a directory, whatever of it there is."""
    shutil.rmtree(path, ignore_errors=True)
