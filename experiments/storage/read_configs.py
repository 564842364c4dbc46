"""Reading of the configurations of many runs, of which most differ only in the seed."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..config.saved import parse_saved
from ..config.schema import Config
from ..system.errors import ConfigError

# The lines that differ among the runs of a sweep, as `to_yaml` writes plain values.
SEED = re.compile(r"^seed: (0|[1-9][0-9]*)\n(?=\w)", re.MULTILINE)
RUN_DIR = re.compile(r"^run_dir: ([\w./,=-]*/[\w./,=-]*)\n(?=\w)", re.MULTILINE)


class ConfigReader:
    """A reader of configurations that parses those that differ only in the seed once.

    To parse a configuration takes a hundred times as long as to read its file.
    """

    def __init__(self) -> None:
        """Start without any configuration in memory."""
        self.known: dict[str, Config] = {}

    def read(self, path: Path) -> Config:
        """Read the configuration of a run from its file.

        Raises:
          ConfigError: the file cannot be read, or is not a configuration.
        """
        try:
            text = path.read_text()
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path} cannot be read: {error}") from None
        own: dict[str, Any] = {}
        common = text
        for name, line, convert in (("seed", SEED, int), ("run_dir", RUN_DIR, str)):
            if len(values := line.findall(text)) == 1:
                common = line.sub(f"{name}: _\n", common)
                own[name] = convert(values[0])
        if common not in self.known:
            self.known[common] = parse_saved(text, str(path)).config
        return replace(self.known[common], **own)
