"""Statistics over seeds: SciPy's, in the shapes that the reports need."""

from collections.abc import Sequence

import numpy as np
from scipy import stats

RESAMPLES = 2000


def bootstrap_interval(
    values: np.ndarray, statistic=np.mean
) -> tuple[np.ndarray, np.ndarray] | None:
    """The 95% percentile bootstrap interval over the first axis; None of a single seed.

    Args:
      values: [S] or [S, P].
      statistic: of an array along an axis.

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
    """The mean of the middle half (Agarwal et al., 2021).

    >>> float(interquartile_mean(np.array([0.0, 1.0, 2.0, 100.0])))
    1.5
    """
    return stats.trim_mean(values, 0.25, axis=axis)


def probability_of_improvement(ours: np.ndarray, theirs: np.ndarray) -> float:
    """P(X > Y) + P(X = Y) / 2 of a run of each: the Mann-Whitney statistic.

    >>> probability_of_improvement(np.array([1.0, 2.0]), np.array([1.0, 1.0]))
    0.75
    """
    if np.ptp(np.concatenate([ours, theirs])) == 0:
        return 0.5  # SciPy warns of what has no order
    return float(stats.mannwhitneyu(ours, theirs).statistic / (len(ours) * len(theirs)))


def mean_improvement(
    pairs: Sequence[tuple[np.ndarray, np.ndarray]],
) -> tuple[float, tuple[float, float] | None]:
    """The mean of `probability_of_improvement` over tasks, and its 95% bootstrap interval over runs.

    Runs are drawn anew within each task and algorithm; None where one of them has a single run.

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
    """The thesis' smoothing: y_k = weight * y_k-1 + (1 - weight) * x_k from y_0 = x_0.

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
    """Curves of steps and values on one grid, each held until its next step.

    The grid goes from where all have begun to where the first ends.

    Returns:
      Steps [P] and values [S, P].

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
