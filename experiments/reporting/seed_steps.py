"""How many steps the seeds of a group of runs have, as text."""

from collections import Counter
from collections.abc import Sequence

from ..storage.read_runs import SeedData

MOST = 4  # different numbers of steps that are listed


def differ_in_steps(seeds: Sequence[SeedData]) -> bool:
    """Return True if the seeds end at different steps."""
    return len(set(map(last_step, seeds))) > 1


def last_step(seed: SeedData) -> int:
    """Return the number of steps of a seed so far."""
    return int(seed.metrics["step"][-1])


def format_ends(seeds: Sequence[SeedData]) -> str:
    """Format the last step of each seed, in millions. See `format_million_steps`."""
    return format_million_steps(list(map(last_step, seeds)))


def format_million_steps(steps: Sequence[int]) -> str:
    """Format the steps of several seeds, in millions, the smallest first.

    Only the smallest and the largest are given if there are more than `MOST` different ones.

    >>> format_million_steps([577_000, 16_000]), format_million_steps([2_000_000] * 3)
    ('0.016 and 0.577', '2')
    >>> format_million_steps([1_000_000] * 9 + [500_000])
    '0.5 and 1 (9 seeds)'
    >>> format_million_steps(range(1_000_000, 9_000_000, 1_000_000))
    '1 to 8'
    """
    counts = Counter(f"{count / 1e6:.6g}" for count in sorted(steps))
    if len(counts) > MOST:
        least, *_, most = counts
        return f"{least} to {most}"
    each = [
        end if n == 1 or len(counts) == 1 else f"{end} ({n} seeds)" for end, n in counts.items()
    ]
    return " and ".join(filter(None, [", ".join(each[:-1]), each[-1]]))
