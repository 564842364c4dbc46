"""The ranges of constructor arguments, as annotations that a program can read.

This file imports nothing but types: the laboratory reads it without importing jax.
"""

from typing import Annotated, NamedTuple


class Range(NamedTuple):
    """The values that a number may have; None: no bound.

    Attributes:
      low: the smallest allowed value.
      above: a bound that values must exceed.
      high: the largest allowed value.
    """

    low: float | None = None
    above: float | None = None
    high: float | None = None


Weight = Annotated[float, Range(low=0)]  # of a term of a sum; also a distance
Positive = Annotated[float, Range(above=0)]
Share = Annotated[float, Range(above=0, high=1)]  # of a whole, and not none of it
Decay = Annotated[float, Range(low=0, high=1)]  # of an average; also a probability
Count = Annotated[int, Range(low=1)]
HashBits = Annotated[int, Range(low=1, high=24)]  # 2^24 counters are 64 MB
