"""Checkpoints: written atomically during training, and verified before they are read.

checkpoints/<iteration>/arrays.npz     every array by its path in the state; `numpy.load` reads it
checkpoints/<iteration>/manifest.json  the digest of the arrays, and the marks of the logs
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

KEEP = 2  # number of newest checkpoints to keep; the best one is kept too
MANIFEST = "manifest.json"
ARRAYS = "arrays.npz"


class CheckpointError(Exception):
    """The error for a checkpoint that differs from what was written, or does not fit."""


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

    def save(self, iteration: int, state: TrainState, more: dict[str, Any]) -> None:
        """Start an asynchronous write of the current state; only one write runs at a time.

        Args:
          iteration: the number of iterations that the state has completed.
          state: the state; it may be donated as soon as this returns.
          more: further entries of the manifest; `saved_return` reads from it which is the best.

        Raises:
          OSError: the previous checkpoint could not be written.
        """
        self.wait()
        if not self.writes:
            self.newest = iteration
            return
        tree = jax.tree.map(np.array, unwrap_key(state))  # a copy: the buffers are reused
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
          OSError: the checkpoint could not be written.
        """
        self.join()
        if self.error is not None:
            error, self.error = self.error, None
            cause = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise OSError(f"a checkpoint: {cause}{self.last_good_message()}") from error

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
          CheckpointError: the checkpoint is not complete, has other shapes or dtypes, or holds
            another iteration.
        """
        tree, _ = read_tree(self.path / str(step), unwrapped_shapes(like))
        if np.any(np.asarray(tree.iteration) != step):
            raise CheckpointError(f"checkpoint {step} holds the state of another iteration")
        return tree._replace(key=jax.random.wrap_key_data(tree.key))


def unwrap_key(state: TrainState) -> TrainState:
    """Return the state with its random key as plain integers."""
    return state._replace(key=jax.random.key_data(state.key))


def unwrapped_shapes(like: TrainState) -> Any:
    """Return the shapes and dtypes of a state after `unwrap_key`."""
    return jax.eval_shape(unwrap_key, like)


def saved_return(path: Path) -> float:
    """Return the last-100 return in the manifest of a checkpoint, or -inf."""
    try:
        found = read_manifest(path)["last100"]
    except (CheckpointError, KeyError):
        return -np.inf
    return found if isinstance(found, float) and np.isfinite(found) else -np.inf


def write_tree(path: Path, tree: Any, manifest: dict[str, Any]) -> None:
    """Write a tree of arrays to the directory `path`, atomically.

    Args:
      path: the new directory; an existing one is replaced.
      tree: a pytree of numpy arrays.
      manifest: the entries of the manifest; the digest of the arrays is added.

    Raises:
      OSError: for example, the disk is full; no part of the new directory is left.
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
        remove_directory(path)  # a damaged one of the same iteration
        new.rename(path)
        for place in (path.parent, path.parent.parent):  # so that the new names are on the disk too
            fsync_path(place)
    except BaseException:
        remove_directory(new)
        raise


def read_manifest(path: Path) -> dict[str, Any]:
    """Return the manifest of the checkpoint at `path`, compared with its digest.

    Raises:
      CheckpointError: the manifest is missing, or is not what was written.
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
    """Return the manifest at `path` after comparing every byte of the arrays with their digest.

    Args:
      path: the directory of the checkpoint.
      fits: a function that raises an exception if the run's other files do not match the manifest.

    Raises:
      CheckpointError: the checkpoint cannot be used; the message says why in a few words.
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
    except Exception as error:  # an untrusted manifest may cause any exception
        raise CheckpointError(str(error) or type(error).__name__) from None
    return manifest


def read_tree(path: Path, like: Any) -> tuple[Any, dict[str, Any]]:
    """Return the tree at `path` and its manifest.

    Args:
      path: the directory of the checkpoint.
      like: a pytree with the expected shapes and dtypes.

    Raises:
      CheckpointError: the tree is not what was written, or does not match `like`.
    """
    manifest = verify_manifest(path)
    try:
        with np.load(path / ARRAYS, allow_pickle=False) as archive:
            found = dict(archive)
    except Exception as error:  # the digest fits, but the file may still be invalid
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
    """Return every array of a tree with its path, such as params/ppo/torso/kernel."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return [(jax.tree_util.keystr(path, simple=True, separator="/"), x) for path, x in leaves]


def describe_array(array: Any) -> str:
    """Describe an array as "dtype[shape]", or "none"."""
    return "none" if array is None else f"{array.dtype}{list(array.shape)}"


def file_digest(path: Path) -> str:
    """Return the SHA-256 digest of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def remove_directory(path: Path) -> None:
    """Remove a directory and its content; errors are ignored."""
    shutil.rmtree(path, ignore_errors=True)
