"""A log that is only ever appended to, and can be cut back to where it once stood."""

import hashlib
import os
from pathlib import Path
from typing import TypedDict


class Mark(TypedDict):
    """Where a log stood: its length in bytes and the digest of them."""

    bytes: int
    sha256: str


class Log:
    """A text file, written through to the disk whenever it is marked."""

    def __init__(self, path: Path, mark: Mark | None = None):
        """Open it at a mark, or empty. What stood after the mark is cut off.

        Raises:
          ValueError: what stands before the mark is not what stood there when it was made.
        """
        self.path = path
        self.digest = hashlib.sha256()
        kept = holds(path, mark) if mark is not None else b""
        self.digest.update(kept)
        self.size = len(kept)
        self.file = path.open("r+b" if path.exists() else "x+b")
        self.file.truncate(self.size)
        self.file.seek(self.size)

    def write(self, text: str) -> None:
        """Append."""
        data = text.encode()
        self.file.write(data)
        self.digest.update(data)
        self.size += len(data)

    def flush(self) -> None:
        """Hand what was written to the system: it outlives this process."""
        self.file.flush()

    def mark(self) -> Mark:
        """Write it through to the disk, where it outlives a power cut, and say where it stands."""
        self.file.flush()
        os.fsync(self.file.fileno())
        return {"bytes": self.size, "sha256": self.digest.hexdigest()}

    def close(self) -> None:
        """Close the file."""
        self.file.close()


def holds(path: Path, mark: Mark) -> bytes:
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
