"""The run directory: claimed under a lock before anything is written to it."""

import fcntl
import os
import secrets
import shutil
import time
from pathlib import Path

from experiments.config import to_yaml
from experiments.options import Config, ConfigError

LOCK = ".lock"


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
        self.resumed = config.resume is not None
        made = first_missing(self.path)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self.lock = os.open(self.path / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            if made is not None:
                shutil.rmtree(made, ignore_errors=True)
            raise ConfigError(f"cannot write to {self.path}: {error.strerror}") from None
        self.made = made
        try:
            fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ConfigError(f"run directory {self.path} is in use by another run") from None
        if not self.resumed and any(p.name != LOCK for p in self.path.iterdir()):
            raise ConfigError(
                f"run directory {self.path} is not empty (to go on: resume={self.path})"
            )

    def abandon(self) -> None:
        """Leave no trace, where nothing was written yet."""
        os.close(self.lock)
        if self.resumed:
            return
        (self.path / LOCK).unlink(missing_ok=True)
        if self.made is not None:
            shutil.rmtree(self.made, ignore_errors=True)

    def begin(self, config: Config, versions: dict[str, str]) -> None:
        """Write `config.yaml`, from which the run can be resumed and repeated."""
        path = self.path / "config.yaml"
        if path.exists():
            return
        head = "".join(f"# {name} {version}\n" for name, version in versions.items())
        replace(path, head + to_yaml(config))


def fresh(config: Config) -> Path:
    """runs/<env>/<algo>/<time>-<id>"""
    name = config.env.name.replace("/", "-")
    stamp = f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(2)}"
    return Path("runs") / name / config.algo.name / stamp


def first_missing(path: Path) -> Path | None:
    """The outermost directory on the way to `path` that is not there yet."""
    missing = [p for p in (path, *path.parents) if not p.exists()]
    return missing[-1] if missing else None


def replace(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    new = path.with_name(f".{path.name}.new")
    with new.open("w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)
