"""A log that is only ever appended to, and can be cut back to where it once stood."""

import errno
import hashlib
import os
from pathlib import Path
from typing import TypedDict


class LogMark(TypedDict):
    """Where a log stood: its length in bytes and the digest of them."""

    bytes: int
    sha256: str


class AppendLog:
    """A text file that holds whole lines, written through to the disk whenever it is marked."""

    def __init__(self, path: Path, mark: LogMark | None = None):
        """Open it at a mark, or empty. What stood after the mark is cut off.

        Raises:
          ValueError: what stands before the mark is not what stood there when it was made.
        """
        self.path = path
        kept = read_until_mark(path, mark) if mark is not None else b""
        self.digest = hashlib.sha256(kept)
        self.size = len(kept)  # as it stands in the file
        self.pending = bytearray()
        self.file = path.open("r+b" if path.exists() else "x+b", buffering=0)
        self.file.truncate(self.size)
        self.file.seek(self.size)

    def write(self, text: str) -> None:
        """Append, with the next flush."""
        self.pending += text.encode()

    def flush(self) -> None:
        """Hand what was written to the system, all of it or nothing: it outlives this process.

        Raises:
          OSError: there is no room for it.
        """
        data, self.pending = bytes(self.pending), bytearray()
        if data and self.file.write(data) != len(data):
            self.file.truncate(self.size)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
        self.digest.update(data)
        self.size += len(data)

    def mark(self) -> LogMark:
        """Write it through to the disk, where it outlives a power cut, and say where it stands."""
        self.flush()
        os.fsync(self.file.fileno())
        return {"bytes": self.size, "sha256": self.digest.hexdigest()}

    def close(self) -> None:
        """Close the file; what was not flushed is not in it."""
        self.file.close()


def read_until_mark(path: Path, mark: LogMark) -> bytes:
    """What a log held when it was marked.

    Raises:
      ValueError: it holds something else now.
    """
    try:
        with path.open("rb") as file:
            held = file.read(mark["bytes"])
    except FileNotFoundError:
        raise ValueError(f"{path.name} is missing") from None
    if hashlib.sha256(held).hexdigest() != mark["sha256"]:
        raise ValueError(f"{path.name} is not what was written")
    return held
