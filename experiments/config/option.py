"""`option(default, meaning)`: a field of a configuration, with its meaning and its range."""

from collections.abc import Sequence
from dataclasses import field
from typing import Any


def option(
    default: Any,
    about: str,
    *,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    choices: Sequence[str] | None = None,
) -> Any:
    """Return a dataclass field with its meaning and its range.

    Args:
      default: the default value.
      about: the meaning of the option, for `--help`.
      low: the smallest allowed value, or None.
      high: the largest allowed value, or None.
      above: a bound that values must exceed, not itself allowed, or None.
      choices: the allowed values, or None.
    """
    metadata = {"about": about, "low": low, "high": high, "above": above, "choices": choices}
    if isinstance(default, dict):
        return field(default_factory=lambda: dict(default), metadata=metadata)
    return field(default=default, metadata=metadata)
