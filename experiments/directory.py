"""The run directory: claimed under a lock before anything is written to it."""

import fcntl
import os
import re
import secrets
import shutil
import tempfile
import time
from pathlib import Path

from experiments.options import Config, ConfigError
from experiments.stored import CONFIG, Stored, read, to_yaml

LOCK = ".lock"
TOLD = "tracker.json"  # what a tracker was told; it is opened before there is a config.yaml


class Directory:
    """A run directory that no other process writes to while this one holds it.

    The lock is the kernel's (flock): it goes with the process, however that ends.
    """

    def __init__(self, config: Config):
        """Find the place and lock it.

        Raises:
          ConfigError: it is in use, holds something else, or cannot be written to.
        """
        self.path = Path(config.run_dir) if config.run_dir else fresh(config)
        self.shared = self.path  # where all hosts read
        self.resumed = config.resume is not None
        self.made = missing(self.path)
        try:
            ours = self.resumed or (self.path / LOCK).exists()
            if not ours and self.path.is_dir() and self.holds_something():
                raise ConfigError(self.not_empty())
            self.path.mkdir(parents=True, exist_ok=True)
            self.lock = os.open(self.path / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        except (OSError, ValueError) as error:
            self.unmake()
            cause = getattr(error, "strerror", None) or error
            raise ConfigError(f"cannot write to {self.path}: {cause}") from None
        try:
            fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self.close()
            raise ConfigError(f"run directory {self.path} is in use by another run") from None
        if not self.resumed and self.holds_something():
            self.close()
            raise ConfigError(self.not_empty())

    def holds_something(self) -> bool:
        """Whether there is more than a run leaves that was killed before it began."""
        early = (LOCK, unfinished(CONFIG), TOLD, unfinished(TOLD))
        return any(entry.name not in early for entry in self.path.iterdir())

    def not_empty(self) -> str:
        """Why a directory with something in it is refused."""
        return f"run directory {self.path} is not empty (to go on: resume={self.path})"

    def unmake(self) -> None:
        """Remove the directories that were made for this run, as far as they are empty."""
        for path in self.made:
            try:
                path.rmdir()
            except OSError:
                return

    def abandon(self) -> None:
        """Leave no trace of a run that was refused; its directory was empty when it was claimed."""
        if not self.resumed and not (self.path / CONFIG).exists():
            for entry in self.path.iterdir():
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
            self.unmake()

    def close(self) -> None:
        """Let another run have the directory."""
        os.close(self.lock)

    def begin(self, config: Config, versions: dict[str, str]) -> list[str]:
        """Write `config.yaml`, from which the run can be resumed and repeated.

        Returns a line about each version that is not the one the run was made with.
        """
        path, made_with, past = self.path / CONFIG, versions, None
        if path.exists():
            past = read(path)
            made_with = past.made_with
        elif config.repeat is not None:
            made_with = read(Path(config.repeat)).made_with
        if past is None or past.config.total_steps != config.total_steps:
            replace(path, to_yaml(Stored(config, versions if past is None else made_with)))
        return [
            f"this run was made with {name} {version}, here is {versions.get(name, 'none')}: "
            "its numbers may come out differently"
            for name, version in made_with.items()
            if versions.get(name) != version
        ]


class Elsewhere:
    """What a host has that does not lead: it reads the run, and what it writes is thrown away."""

    def __init__(self, config: Config):
        """Find the run; `run_dir` was said."""
        self.shared, self.path = Path(str(config.run_dir)), Path(tempfile.mkdtemp())
        self.resumed = config.resume is not None

    def begin(self, config: Config, versions: dict[str, str]) -> list[str]:
        """The first host writes the configuration."""
        return []

    def abandon(self) -> None:
        """The run was refused."""

    def close(self) -> None:
        """Throw away what was written."""
        shutil.rmtree(self.path, ignore_errors=True)


def fresh(config: Config) -> Path:
    """runs/<env>/<algo>/<time>-<id>"""
    plain = lambda name: re.sub(r"[^A-Za-z0-9_.-]", "-", name).lstrip(".") or "unnamed"
    stamp = f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(2)}"
    return Path("runs") / plain(config.env.name) / plain(config.algo.name) / stamp


def missing(path: Path) -> list[Path]:
    """The directories on the way to `path` that are not there yet, the innermost first."""
    return [place for place in (path, *path.parents) if not place.exists()]


def replace(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    new = path.with_name(unfinished(path.name))
    try:
        with new.open("w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
    except OSError:
        new.unlink(missing_ok=True)
        raise


def unfinished(name: str) -> str:
    """What a file is called while it is being written."""
    return f".{name}.new"
