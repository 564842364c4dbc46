"""Statistics over seeds, computed with SciPy, in the shapes that the reports need."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy import stats

RESAMPLES = 2000


def bootstrap_interval(
    values: np.ndarray, statistic: Callable[..., Any] = np.mean
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the 95% percentile bootstrap interval of a statistic over seeds.

    Args:
      values: [S] or [S, P]; the first axis is resampled.
      statistic: a function of an array and its `axis`, by default the mean.

    Returns:
      The lower and the upper ends, scalars or [P]; None for a single seed.

    >>> low, high = bootstrap_interval(np.array([1.0, 2.0, 3.0]))
    >>> float(low), float(high)
    (1.0, 3.0)
    """
    if len(values) < 2:
        return None
    found = stats.bootstrap(
        (values,),
        statistic,
        axis=0,
        n_resamples=RESAMPLES,
        method="percentile",
        vectorized=True,
        rng=np.random.default_rng(0),
    )
    return found.confidence_interval.low, found.confidence_interval.high


def interquartile_mean(values: np.ndarray, axis: int = 0) -> np.ndarray:
    """Return the interquartile mean: the mean of the middle half (Agarwal et al., 2021).

    >>> float(interquartile_mean(np.array([0.0, 1.0, 2.0, 100.0])))
    1.5
    """
    return stats.trim_mean(values, 0.25, axis=axis)


def probability_of_improvement(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return P(X > Y) + P(X = Y) / 2 for a run X of `ours` and a run Y of `theirs`.

    This is the Mann-Whitney statistic divided by the number of pairs of runs.

    >>> probability_of_improvement(np.array([1.0, 2.0]), np.array([1.0, 1.0]))
    0.75
    """
    if np.ptp(np.concatenate([ours, theirs])) == 0:
        return 0.5  # SciPy warns if all values are equal
    return float(stats.mannwhitneyu(ours, theirs).statistic / (len(ours) * len(theirs)))


def mean_improvement(
    pairs: Sequence[tuple[np.ndarray, np.ndarray]],
) -> tuple[float, tuple[float, float] | None]:
    """Return the mean probability of improvement over tasks, with its 95% bootstrap interval.

    The bootstrap resamples the runs within each task and algorithm.

    Args:
      pairs: for each task, the results of our runs and of their runs.

    Returns:
      The mean of `probability_of_improvement`, and its interval; None in place of the interval if
      an algorithm has only one run of a task.

    >>> mean_improvement([(np.array([2.0, 3.0]), np.array([0.0, 1.0]))])
    (1.0, (1.0, 1.0))
    """
    count = len(pairs)

    def mean(*samples):
        both = zip(samples[:count], samples[count:], strict=True)
        return float(np.mean([probability_of_improvement(ours, theirs) for ours, theirs in both]))

    samples = [ours for ours, _ in pairs] + [theirs for _, theirs in pairs]
    value = mean(*samples)
    if min(map(len, samples)) < 2:
        return value, None
    found = stats.bootstrap(
        samples,
        mean,
        n_resamples=RESAMPLES // 4,
        method="percentile",
        vectorized=False,
        rng=np.random.default_rng(0),
    )
    return value, (float(found.confidence_interval.low), float(found.confidence_interval.high))


def exponential_smoothing(values: np.ndarray, weight: float = 0.99) -> np.ndarray:
    """Smooth values as in the thesis: y_k = weight * y_k-1 + (1 - weight) * x_k, with y_0 = x_0.

    >>> exponential_smoothing(np.array([1.0, 2.0, 0.0]), 0.5).tolist()
    [1.0, 1.5, 0.75]
    """
    from scipy.signal import lfilter

    if not len(values):
        return values
    return lfilter([1 - weight], [1, -weight], values, zi=[weight * values[0]])[0]


def resample_curves(
    curves: Sequence[tuple[np.ndarray, np.ndarray]], points: int = 200
) -> tuple[np.ndarray, np.ndarray]:
    """Resample curves on a common grid of steps; a value holds until the next step of its curve.

    The grid extends from the latest first step to the earliest last step of the curves.

    Args:
      curves: steps and values of each curve.
      points: P, of the grid.

    Returns:
      The steps of the grid [P] and the values [S, P].

    >>> steps, values = resample_curves([([0, 10], [1, 2]), ([0, 5], [3, 4])], 3)
    >>> steps.tolist(), values.tolist()
    ([0.0, 2.5, 5.0], [[1.0, 1.0, 1.0], [3.0, 3.0, 4.0]])
    """
    start = max(steps[0] for steps, _ in curves)
    end = min(steps[-1] for steps, _ in curves)
    grid = np.linspace(start, max(start, end), points)
    held = [
        np.asarray(values, float)[np.searchsorted(steps, grid, side="right") - 1]
        for steps, values in curves
    ]
    return grid, np.stack(held)
