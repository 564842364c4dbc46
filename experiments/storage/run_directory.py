"""The run directory: claimed under a lock before anything is written to it."""

import fcntl
import os
import secrets
import shutil
import tempfile
import time
from pathlib import Path

from ..config.saved import CONFIG, SavedConfig, read_saved, to_yaml
from ..config.schema import Config
from ..system.errors import ConfigError
from ..system.files import safe_file_name, temporary_name, write_atomically

LOCK = ".lock"
TRACKER_STATE = (
    "tracker.json"  # what a tracker was told; it is opened before there is a config.yaml
)


class RunDirectory:
    """A run directory that no other process writes to while this one holds it.

    The lock is the kernel's (flock): it goes with the process, however that ends.
    """

    def __init__(self, config: Config):
        """Find the place and lock it.

        Raises:
          ConfigError: it is in use, holds something else, or cannot be written to.
        """
        self.path = Path(config.run_dir) if config.run_dir else new_run_path(config)
        self.shared = self.path  # where all hosts read
        self.resumed = config.resume is not None
        self.created = missing_parents(self.path)
        try:
            ours = self.resumed or (self.path / LOCK).exists()
            if not ours and self.path.is_dir() and self.is_nonempty():
                raise ConfigError(self.not_empty_message())
            self.path.mkdir(parents=True, exist_ok=True)
            self.lock = os.open(self.path / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        except (OSError, ValueError) as error:
            self.remove_created_dirs()
            cause = getattr(error, "strerror", None) or error
            raise ConfigError(f"cannot write to {self.path}: {cause}") from None
        try:
            fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self.close()
            raise ConfigError(f"run directory {self.path} is in use by another run") from None
        if not self.resumed and self.is_nonempty():
            self.close()
            raise ConfigError(self.not_empty_message())

    def is_nonempty(self) -> bool:
        """Whether there is more than a run leaves that was killed before it began."""
        early = (LOCK, temporary_name(CONFIG), TRACKER_STATE, temporary_name(TRACKER_STATE))
        return any(entry.name not in early for entry in self.path.iterdir())

    def not_empty_message(self) -> str:
        """Why a directory with something in it is refused."""
        return f"run directory {self.path} is not empty (to go on: resume={self.path})"

    def remove_created_dirs(self) -> None:
        """Remove the directories that were made for this run, as far as they are empty."""
        for path in self.created:
            try:
                path.rmdir()
            except OSError:
                return

    def discard(self) -> None:
        """Leave no trace of a run that was refused; its directory was empty when it was claimed."""
        if not self.resumed and not (self.path / CONFIG).exists():
            for entry in self.path.iterdir():
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
            self.remove_created_dirs()

    def close(self) -> None:
        """Let another run have the directory."""
        os.close(self.lock)

    def begin(self, config: Config, versions: dict[str, str]) -> list[str]:
        """Write `config.yaml`, from which the run can be resumed and repeated.

        Returns a line about each version that is not the one the run was made with.
        """
        path, made_with, past = self.path / CONFIG, versions, None
        if path.exists():
            past = read_saved(path)
            made_with = past.made_with
        elif config.repeat is not None:
            made_with = read_saved(Path(config.repeat)).made_with
        if past is None or past.config.total_steps != config.total_steps:
            write_atomically(
                path, to_yaml(SavedConfig(config, versions if past is None else made_with))
            )
        return [
            f"this run was made with {name} {version}, here is {versions.get(name, 'none')}: "
            "its numbers may come out differently"
            for name, version in made_with.items()
            if versions.get(name) != version
        ]


class FollowerDirectory:
    """What a host has that does not lead: it reads the run, and what it writes is thrown away."""

    def __init__(self, config: Config):
        """Find the run; `run_dir` was said."""
        self.shared, self.path = Path(str(config.run_dir)), Path(tempfile.mkdtemp())
        self.resumed = config.resume is not None

    def begin(self, config: Config, versions: dict[str, str]) -> list[str]:
        """The first host writes the configuration."""
        return []

    def discard(self) -> None:
        """The run was refused."""

    def close(self) -> None:
        """Throw away what was written."""
        shutil.rmtree(self.path, ignore_errors=True)


def new_run_path(config: Config) -> Path:
    """runs/<env>/<algo>/<time>-<id>"""
    stamp = f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(2)}"
    return Path("runs") / safe_file_name(config.env.name) / safe_file_name(config.algo.name) / stamp


def missing_parents(path: Path) -> list[Path]:
    """The directories on the way to `path` that are not there yet, the innermost first."""
    return [place for place in (path, *path.parents) if not place.exists()]
