"""Atomic file writes, and safe file names."""

import os
import re
from pathlib import Path


def write_atomically(path: Path, text: str) -> None:
    """Write a text file atomically, with fsync; readers see the old file or the new one.

    Raises:
      OSError: the file cannot be written; no part of the new file is left.
    """
    new = path.with_name(temporary_name(path.name))
    try:
        with new.open("w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
    except OSError:
        new.unlink(missing_ok=True)
        raise


def temporary_name(name: str) -> str:
    """Return the name that a file has while it is being written."""
    return f".{name}.new"


def fsync_path(path: Path) -> None:
    """Write a file or a directory to the disk with fsync, so that it survives a power failure."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def safe_file_name(text: str) -> str:
    """Return the text with a dash in place of each character that is unsafe in a file name.

    >>> safe_file_name("minigrid:MiniGrid-N6/v0"), safe_file_name("..")
    ('minigrid-MiniGrid-N6-v0', 'unnamed')
    """
    return re.sub(r"[^A-Za-z0-9_.-]", "-", text).lstrip(".") or "unnamed"


def is_file(path: Path) -> bool:
    """Return True if `path` is a file; invalid paths count as missing."""
    try:
        return path.is_file()
    except OSError:
        return False


def exists(path: Path) -> bool:
    """Return True if there is something at `path`; invalid paths count as missing."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False
