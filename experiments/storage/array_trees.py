"""A tree of arrays on the disk: written whole or not at all, verified before it is read.

<path>/arrays.npz     every array by its path in the tree; `numpy.load` reads it
<path>/manifest.json  its digest, and what else belongs to it
"""

import hashlib
import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..system.files import fsync_path, temporary_name

MANIFEST = "manifest.json"
ARRAYS = "arrays.npz"
KEY_WORDS = {2: "threefry2x32", 4: "rbg"}  # jax's generators by the words of a key


class CheckpointError(Exception):
    """The error for a checkpoint that differs from what was written, or does not fit."""


class OtherArraysError(CheckpointError):
    """The error of a checkpoint that is whole, but holds other arrays than are expected."""


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
        raise CheckpointError(f"{MANIFEST} does not match its digest") from None
    if hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest() != seal:
        raise CheckpointError(f"{MANIFEST} does not match its digest")
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
            raise CheckpointError(f"{ARRAYS} does not match its digest")
        fits(manifest)
    except FileNotFoundError as error:
        raise CheckpointError(f"{Path(error.filename).name} is missing") from None
    except KeyError as error:
        raise CheckpointError(f"{MANIFEST} has no entry {error}") from None
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
      CheckpointError: the tree is not what was written.
      OtherArraysError: the tree does not match `like`.
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
            key = name.rpartition("/")[2] == "key"
            raise (CheckpointError if key else OtherArraysError)(
                mismatch_message(name, found.get(name), wanted)
            )
        leaves.append(found[name])
    return jax.tree.unflatten(jax.tree.structure(like), leaves), manifest


def named_leaves(tree: Any) -> list[tuple[str, Any]]:
    """Return every array of a tree with its path, such as params/ppo/torso/kernel."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return [(jax.tree_util.keystr(path, simple=True, separator="/"), x) for path, x in leaves]


def mismatch_message(name: str, found: Any, wanted: Any) -> str:
    """Return why an array does not fit; a random key of another generator is named as such.

    Args:
      name: the path of the array in the tree.
      found: the stored array, or None.
      wanted: what is expected.
    """
    text = f"{name} is {describe_array(found)}, not {describe_array(wanted)}"
    if name.rpartition("/")[2] != "key" or found is None or not found.shape:
        return text
    made_with = KEY_WORDS.get(found.shape[-1])
    if made_with is None or found.shape[:-1] != wanted.shape[:-1]:
        return text
    return f"{other_generator(made_with)} ({text})"


def current_generator() -> str:
    """Return the name of the random generator that jax uses in this process."""
    return str(jax.random.key_impl(jax.random.key(0)))


def other_generator(made_with: str) -> str:
    """Return the message that random keys are of another generator than jax uses here."""
    return (
        f"its random keys are of jax's generator {made_with}, but JAX_DEFAULT_PRNG_IMPL is "
        f"{current_generator()} here: set JAX_DEFAULT_PRNG_IMPL={made_with}"
    )


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
