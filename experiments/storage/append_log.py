"""A log that is only appended to, and can be truncated to an earlier mark."""

import errno
import hashlib
import os
from pathlib import Path
from typing import TypedDict


class LogMark(TypedDict):
    """A position in a log: its length in bytes and the digest of these bytes."""

    bytes: int
    sha256: str


class AppendLog:
    """A text file of whole lines, written to the disk with fsync whenever it is marked."""

    def __init__(self, path: Path, mark: LogMark | None = None):
        """Open the file and truncate it to the mark, or to nothing without a mark.

        Raises:
          ValueError: the file is missing, or its content before the mark has changed.
        """
        self.path = path
        kept = read_until_mark(path, mark) if mark is not None else b""
        self.digest = hashlib.sha256(kept)
        self.size = len(kept)  # bytes in the file, without `pending`
        self.pending = bytearray()
        self.file = path.open("r+b" if path.exists() else "x+b", buffering=0)
        self.file.truncate(self.size)
        self.file.seek(self.size)

    def write(self, text: str) -> None:
        """Append a text, which the next flush writes."""
        self.pending += text.encode()

    def flush(self) -> None:
        """Write all pending text to the file, or nothing, so that it survives this process.

        Raises:
          OSError: the disk is full.
        """
        data, self.pending = bytes(self.pending), bytearray()
        if data and self.file.write(data) != len(data):
            self.file.truncate(self.size)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
        self.digest.update(data)
        self.size += len(data)

    def mark(self) -> LogMark:
        """Flush and fsync the log, so that it survives a power failure, and return its mark."""
        self.flush()
        os.fsync(self.file.fileno())
        return {"bytes": self.size, "sha256": self.digest.hexdigest()}

    def close(self) -> None:
        """Close the file; pending text is lost."""
        self.file.close()


def read_until_mark(path: Path, mark: LogMark) -> bytes:
    """Return the content of a log up to a mark.

    Raises:
      ValueError: the file is missing, or its content before the mark has changed.
    """
    try:
        with path.open("rb") as file:
            held = file.read(mark["bytes"])
    except FileNotFoundError:
        raise ValueError(f"{path.name} is missing") from None
    if hashlib.sha256(held).hexdigest() != mark["sha256"]:
        raise ValueError(f"{path.name} does not match its digest")
    return held
