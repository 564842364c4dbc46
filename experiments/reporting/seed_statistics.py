"""Statistics over seeds, in the shapes that the reports need."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy import stats

RESAMPLES = 2000


def bootstrap_interval(
    values: np.ndarray, statistic: Callable[..., Any] = np.mean
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the 95% percentile bootstrap interval of a statistic over seeds.

    The numbers are those of `scipy.stats.bootstrap` with the same random numbers. The mean is a
    product of matrices here, which is much faster for curves.

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
    drawn = np.random.default_rng(0).integers(0, len(values), (RESAMPLES, len(values)))
    if statistic is np.mean:
        return percentile_interval(count_draws(drawn) @ values / len(values))
    return percentile_interval(statistic(values[drawn], axis=1))


def count_draws(drawn: np.ndarray) -> np.ndarray:
    """Count how often each resample holds each item.

    Args:
      drawn: the items of each resample, int [R, S], from 0 to S - 1.

    Returns:
      The counts, float64 [R, S].

    >>> count_draws(np.array([[0, 0, 2], [1, 2, 0]])).tolist()
    [[2.0, 0.0, 1.0], [1.0, 1.0, 1.0]]
    """
    resamples, items = drawn.shape
    places = drawn + items * np.arange(resamples)[:, None]
    counts = np.bincount(places.ravel(), minlength=drawn.size)
    return counts.reshape(resamples, items).astype(float)


def percentile_interval(found: np.ndarray, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Return the quantiles over the first axis that have the middle `level` between them."""
    low, high = np.quantile(found, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return low, high


def interquartile_mean(values: np.ndarray, axis: int = 0) -> np.ndarray:
    """Return the interquartile mean: the mean of the middle half (Agarwal et al., 2021).

    >>> float(interquartile_mean(np.array([0.0, 1.0, 2.0, 100.0])))
    1.5
    """
    return stats.trim_mean(values, 0.25, axis=axis)


def compare_pairs(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Return 1 where a run of `ours` has more than a run of `theirs`, 1/2 where as much, else 0.

    Returns:
      [X, Y] for X runs of `ours` and Y runs of `theirs`.
    """
    more, same = ours[:, None] > theirs, ours[:, None] == theirs
    return more + same / 2


def probability_of_improvement(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return P(X > Y) + P(X = Y) / 2 for a run X of `ours` and a run Y of `theirs`.

    This is the Mann-Whitney statistic divided by the number of pairs of runs.

    >>> probability_of_improvement(np.array([1.0, 2.0]), np.array([1.0, 1.0]))
    0.75
    """
    return float(compare_pairs(ours, theirs).mean())


def mean_improvement(
    pairs: Sequence[tuple[np.ndarray, np.ndarray]],
) -> tuple[float, tuple[float, float] | None]:
    """Return the mean probability of improvement over tasks, with its 95% bootstrap interval.

    The bootstrap resamples the runs within each task and algorithm. A resample holds a pair of
    runs as often as the product of their counts, so that all resamples are compared by a product
    of matrices and no run is compared twice.

    Args:
      pairs: for each task, the results of our runs and of their runs.

    Returns:
      The mean of `probability_of_improvement`, and its interval; None in place of the interval if
      an algorithm has only one run of a task.

    >>> mean_improvement([(np.array([2.0, 3.0]), np.array([0.0, 1.0]))])
    (1.0, (1.0, 1.0))
    """
    wins = [compare_pairs(ours, theirs) for ours, theirs in pairs]
    value = float(np.mean([task.mean() for task in wins]))
    if min(min(task.shape) for task in wins) < 2:
        return value, None
    random = np.random.default_rng(0)

    def resample(runs: int) -> np.ndarray:
        return count_draws(random.integers(0, runs, (RESAMPLES // 4, runs)))

    ours = [resample(task.shape[0]) for task in wins]  # all of ours are drawn first, as by SciPy
    theirs = [resample(task.shape[1]) for task in wins]
    each = [
        ((mine @ task) * other).sum(1) / task.size
        for mine, task, other in zip(ours, wins, theirs, strict=True)
    ]
    low, high = percentile_interval(np.mean(each, axis=0))
    return value, (float(low), float(high))


def pooled_interquartile_mean(
    tasks: Sequence[np.ndarray],
) -> tuple[float, tuple[float, float] | None]:
    """Return the interquartile mean of the runs of all tasks, with its 95% bootstrap interval.

    The bootstrap resamples the runs within each task (Agarwal et al., 2021).

    Args:
      tasks: the results of each task's runs, at least one run each.

    Returns:
      The mean, and its interval; None in its place if a task has only one run.

    >>> pooled_interquartile_mean([np.zeros(4), np.ones(4)])
    (0.5, (0.5, 0.5))
    """
    value = float(interquartile_mean(np.concatenate(tasks)))
    if min(map(len, tasks)) < 2:
        return value, None
    random = np.random.default_rng(0)
    drawn = [task[random.integers(0, len(task), (RESAMPLES, len(task)))] for task in tasks]
    low, high = percentile_interval(interquartile_mean(np.concatenate(drawn, axis=1), axis=1))
    return value, (float(low), float(high))


def joint_improvement(
    tasks: Sequence[tuple[Sequence[np.ndarray], np.ndarray]], level: float = 0.95
) -> tuple[float, tuple[float, float]]:
    """Return the mean probability of improvement over tasks and methods, with its interval.

    The bootstrap resamples the runs within each task and method; the runs that all methods of a
    task are compared with are drawn once for all of them.

    Args:
      tasks: for each task, the results of each method's runs, and of the runs compared with.
      level: of the interval.

    >>> joint_improvement([([np.array([2.0, 3.0]), np.array([0.0, 0.0])], np.array([1.0, 1.0]))])
    (0.5, (0.5, 0.5))
    """
    random = np.random.default_rng(0)
    draw = lambda runs: count_draws(random.integers(0, runs, (RESAMPLES, runs)))
    values, each = [], []
    for methods, theirs in tasks:
        drawn = draw(len(theirs))
        for ours in methods:
            wins = compare_pairs(ours, theirs)
            values.append(wins.mean())
            each.append(((draw(len(ours)) @ wins) * drawn).sum(1) / wins.size)
    low, high = percentile_interval(np.mean(each, axis=0), level)
    return float(np.mean(values)), (float(low), float(high))


def exponential_smoothing(values: np.ndarray, weight: float = 0.99) -> np.ndarray:
    """Smooth values as in the thesis: y_k = weight * y_k-1 + (1 - weight) * x_k, with y_0 = x_0.

    >>> exponential_smoothing(np.array([1.0, 2.0, 0.0]), 0.5).tolist()
    [1.0, 1.5, 0.75]
    """
    from scipy.signal import lfilter

    if not len(values):
        return values
    return lfilter([1 - weight], [1, -weight], values, zi=[weight * values[0]])[0]
