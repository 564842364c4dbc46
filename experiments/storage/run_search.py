"""Search for run directories below a directory, also behind symbolic links."""

import os
from pathlib import Path

from ..config.saved import CONFIG


def find_run_directories(place: Path) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Find every run directory in a directory and at any depth below it.

    Symbolic links are followed. Each directory is searched once, and has a path without links
    where there is one. A link to one of its own parents is not followed.

    Args:
      place: the directory where the search starts.

    Returns:
      The run directories, sorted, and each path that could not be searched, with the reason.
    """
    found: list[Path] = []
    left_out: list[tuple[Path, str]] = []
    seen: set[tuple[int, int]] = set()
    waiting = [place]
    while waiting:
        links: list[Path] = []  # searched after all directories that need no further link
        while waiting:
            folder = waiting.pop()
            try:
                inner, linked, has_run = read_folder(folder, seen)
            except FileNotFoundError:
                continue  # removed during the search, as old checkpoints are
            except OSError as error:
                left_out.append((folder, f"cannot be searched: {error.strerror}"))
                continue
            waiting += inner
            links += linked
            if has_run:
                found.append(folder)
        for link in sorted(links):
            reason = broken_link_reason(link)
            if reason:
                left_out.append((link, reason))
            elif link.is_dir() and not is_loop(link):
                waiting.append(link)
        waiting.sort(reverse=True)  # the first link is searched first
    return sorted(found), left_out


def read_folder(folder: Path, seen: set[tuple[int, int]]) -> tuple[list[Path], list[Path], bool]:
    """Return the directories and the links in a folder, and whether the folder is a run directory.

    Args:
      folder: the folder; nothing is returned if it was seen before.
      seen: the device and inode of each folder that was seen; this folder is added.

    Raises:
      OSError: the folder cannot be read.
    """
    status = folder.stat()
    identity = (status.st_dev, status.st_ino)
    if identity in seen:
        return [], [], False
    seen.add(identity)
    inner, linked, has_run = [], [], False
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name == CONFIG:
                has_run = True
            elif entry.is_symlink():
                linked.append(folder / entry.name)
            elif entry.is_dir():
                inner.append(folder / entry.name)
    return inner, linked, has_run


def broken_link_reason(link: Path) -> str:
    """Return why a symbolic link leads nowhere; "" if its target exists."""
    try:
        link.stat()
    except FileNotFoundError:
        return f"a symbolic link to nothing: {os.readlink(link)}"
    except OSError as error:
        return f"a symbolic link that cannot be followed: {error.strerror}"
    return ""


def is_loop(link: Path) -> bool:
    """Return True if a link leads to a directory that contains the link."""
    return link.parent.resolve().is_relative_to(link.resolve())
