"""The run directory, locked before anything is written to it."""

import fcntl
import os
import secrets
import shutil
import tempfile
import time
from pathlib import Path

from ..config.command_text import resume_command
from ..config.saved import CONFIG, SavedConfig, read_saved, to_yaml
from ..config.schema import Config
from ..system.errors import ConfigError
from ..system.files import safe_file_name, temporary_name, write_atomically

LOCK = ".lock"
TRACKER_STATE = (
    "tracker.json"  # what was sent to the tracker; this file is written before config.yaml exists
)


class RunDirectory:
    """A run directory that no other process writes to while this process holds its lock.

    The lock is the kernel's (flock): it is released whenever and however the process ends.
    """

    def __init__(self, config: Config):
        """Find or create the directory and lock it.

        Raises:
          ConfigError: the directory is in use, is not empty, or cannot be written to.
        """
        self.path = Path(config.run_dir) if config.run_dir else new_run_path(config)
        self.shared = self.path  # the directory that all hosts read
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
        """Return True if the directory holds more than the files of an aborted start."""
        early = (LOCK, temporary_name(CONFIG), TRACKER_STATE, temporary_name(TRACKER_STATE))
        return any(entry.name not in early for entry in self.path.iterdir())

    def not_empty_message(self) -> str:
        """Return the error message for a directory that is not empty."""
        try:
            command = resume_command(self.path, read_saved(self.path / CONFIG).config)
        except ConfigError:  # there is no run that could be resumed
            return f"run directory {self.path} is not empty; give another run_dir"
        return f"run directory {self.path} is not empty; to resume the run in it: {command}"

    def remove_created_dirs(self) -> None:
        """Remove the directories that were created for this run, up to the first non-empty one."""
        for path in self.created:
            try:
                path.rmdir()
            except OSError:
                return

    def discard(self) -> None:
        """Remove all files of a refused run; its directory was empty when it was locked."""
        if not self.resumed and not (self.path / CONFIG).exists():
            for entry in self.path.iterdir():
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
            self.remove_created_dirs()

    def close(self) -> None:
        """Release the lock, so that another run can use the directory."""
        os.close(self.lock)

    def begin(self, config: Config, versions: dict[str, str]) -> list[str]:
        """Write `config.yaml`, from which the run can be resumed and repeated.

        Returns:
          One line about each version that differs from the version that the run was made with.
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
    """The directory of a host that does not lead: it reads the run; its writes are temporary."""

    def __init__(self, config: Config):
        """Find the run in `run_dir`, which must be given, and create a temporary directory."""
        self.shared, self.path = Path(str(config.run_dir)), Path(tempfile.mkdtemp())
        self.resumed = config.resume is not None

    def begin(self, config: Config, versions: dict[str, str]) -> list[str]:
        """Return no lines; the first host writes the configuration."""
        return []

    def discard(self) -> None:
        """Do nothing when the run is refused."""

    def close(self) -> None:
        """Remove the temporary directory."""
        shutil.rmtree(self.path, ignore_errors=True)


def new_run_path(config: Config) -> Path:
    """Return a new path runs/<env>/<algo>/<time>-<id>."""
    stamp = f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(2)}"
    return Path("runs") / safe_file_name(config.env.name) / safe_file_name(config.algo.name) / stamp


def missing_parents(path: Path) -> list[Path]:
    """Return `path` and its parents that do not exist yet, the innermost first."""
    return [place for place in (path, *path.parents) if not place.exists()]
