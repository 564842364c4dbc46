"""Curves of seeds on common steps, and their mean where not all seeds have the same steps."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .seed_statistics import bootstrap_interval

POINTS = 500  # of a curve, if its seeds have more steps together


class MeanCurve(NamedTuple):
    """The mean over the seeds that have a value at a step, [P] each."""

    mean: np.ndarray  # NaN where no seed has a value
    low: np.ndarray  # of the 95% bootstrap interval of the mean; NaN with fewer than two seeds
    high: np.ndarray
    seeds: np.ndarray  # the number of seeds that have a value


def common_steps(curves: Sequence[tuple[np.ndarray, np.ndarray]], points: int) -> np.ndarray:
    """Return the steps at which curves are compared, sorted.

    They are all steps of the curves, or `points` even steps if these are fewer. The first and the
    last step of each curve are always there, and the step after the last one.

    Args:
      curves: steps and values of each curve.
      points: the number of even steps.
    """
    ends = np.array([[steps[0], steps[-1], steps[-1] + 1] for steps, _ in curves], float)
    latest = ends[:, 1].max()
    own = np.unique(np.concatenate([steps for steps, _ in curves])).astype(float)
    if len(own) > points:
        own = np.round(np.linspace(own[0], latest, points))
    grid = np.union1d(own, ends)
    return grid[grid <= latest]


def resample_curves(
    curves: Sequence[tuple[np.ndarray, np.ndarray]], points: int = POINTS
) -> tuple[np.ndarray, np.ndarray]:
    """Resample curves on common steps; a value holds until the next step of its curve.

    Args:
      curves: steps and values of each curve.
      points: see `common_steps`.

    Returns:
      The steps [P] and the values [S, P]; NaN before the first and after the last step of a curve.

    >>> steps, values = resample_curves([([0, 10], [1, 2]), ([0, 5], [3, 4])])
    >>> steps.tolist()
    [0.0, 5.0, 6.0, 10.0]
    >>> values.tolist()
    [[1.0, 1.0, 1.0, 2.0], [3.0, 4.0, nan, nan]]
    """
    grid = common_steps(curves, points)
    rows = []
    for steps, values in curves:
        held = np.asarray(values, float)[np.searchsorted(steps, grid, side="right") - 1]
        rows.append(np.where((grid >= steps[0]) & (grid <= steps[-1]), held, np.nan))
    return grid, np.stack(rows)


def mean_curve(values: np.ndarray) -> MeanCurve:
    """Compute the mean over the seeds that have a value at each step, with its interval.

    Args:
      values: [S, P], as `resample_curves` returns them; NaN where a seed has no value.

    >>> found = mean_curve(np.array([[1.0, 1.0, 3.0], [3.0, np.nan, np.nan]]))
    >>> found.mean.tolist(), found.seeds.tolist()
    ([2.0, 1.0, 3.0], [2, 1, 1])
    """
    there = np.isfinite(values)
    mean, low, high = np.full((3, values.shape[1]), np.nan)
    sets, which = np.unique(there, axis=1, return_inverse=True)
    for i, seeds in enumerate(sets.T):  # the same seeds have a value at all of these steps
        if not seeds.any():
            continue
        columns = which.reshape(-1) == i
        own = values[np.ix_(seeds, columns)]
        mean[columns] = own.mean(0)
        interval = bootstrap_interval(own)
        if interval is not None:
            low[columns], high[columns] = interval
    return MeanCurve(mean, low, high, there.sum(0))


def count_changes(count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find where the number of seeds changes, while some seed has a value.

    Args:
      count: seeds that have a value at each step, int [P].

    Returns:
      The indices of the last step before each fall, and of the first step after each rise.

    >>> fall, rise = count_changes(np.array([1, 2, 2, 1, 1]))
    >>> fall.tolist(), rise.tolist()
    ([2], [1])
    """
    change = np.diff(count)
    return np.flatnonzero(change < 0), np.flatnonzero(change > 0) + 1
