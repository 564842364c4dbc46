import numpy as np
import pytest
from scipy import stats

from experiments.reporting.seed_statistics import (
    bootstrap_interval,
    exponential_smoothing,
    interquartile_mean,
    mean_improvement,
    probability_of_improvement,
    resample_curves,
)


def test_bootstrap_interval_many_samples_covers_the_mean_at_its_rate():
    draw = np.random.default_rng(0)
    covered = 0
    for _ in range(200):
        low, high = bootstrap_interval(draw.normal(size=30))
        covered += low < 0 < high
    # With 30 samples the percentile bootstrap covers slightly less than 95%: 0.90 to 0.98 passes.
    assert 180 <= covered <= 196


def test_bootstrap_interval_curve_equals_interval_of_each_point():
    values = np.random.default_rng(1).normal(size=(6, 3))
    low, high = bootstrap_interval(values)
    assert low.shape == high.shape == (3,)
    exact = stats.norm.ppf(0.975) * values.std(0) / np.sqrt(6)
    np.testing.assert_allclose((high - low) / 2, exact, rtol=0.2)


def test_bootstrap_interval_one_seed_is_none():
    assert bootstrap_interval(np.array([1.0])) is None


def test_interquartile_mean_outliers_a_quarter_on_each_side_is_left_out():
    values = np.random.default_rng(2).permutation(np.arange(12.0) ** 2)
    assert interquartile_mean(values) == np.mean(np.arange(3.0, 9) ** 2)


def test_probability_of_improvement_one_task_equals_counted_share():
    draw = np.random.default_rng(3)
    ours, theirs = draw.integers(0, 4, 7).astype(float), draw.integers(0, 4, 5).astype(float)
    counted = [(x > y) + (x == y) / 2 for x in ours for y in theirs]
    assert probability_of_improvement(ours, theirs) == pytest.approx(np.mean(counted))
    assert probability_of_improvement(np.zeros(3), np.zeros(2)) == 0.5


def test_mean_improvement_several_tasks_is_mean_with_interval():
    draw = np.random.default_rng(5)
    near = draw.normal(0.5, 1, 40), draw.normal(0, 1, 30)
    far = np.array([5.0, 6.0]), np.array([1.0, 2.0, 3.0])
    value, (low, high) = mean_improvement([near, far])
    assert value == pytest.approx((probability_of_improvement(*near) + 1) / 2)
    # Only the first task has variance: that of the Mann-Whitney statistic; the mean halves it.
    spread = np.sqrt((40 + 30 + 1) / (12 * 40 * 30)) / 2
    assert high - low == pytest.approx(2 * 1.96 * spread, rel=0.25)
    assert mean_improvement([(np.ones(1), np.zeros(3))]) == (1.0, None)


def test_exponential_smoothing_curve_equals_the_recursion():
    values = np.random.default_rng(4).normal(size=50)
    wanted, last = [], values[0]
    for x in values:
        last = 0.99 * last + 0.01 * x
        wanted.append(last)
    np.testing.assert_allclose(exponential_smoothing(values), wanted)
    assert not len(exponential_smoothing(np.array([])))


def test_resample_curves_curves_of_unequal_length_spans_their_overlap():
    steps, values = resample_curves(
        [(np.array([2, 8]), np.array([1, 5])), (np.array([0, 6]), [0, 1])], 5
    )
    np.testing.assert_array_equal(steps, [2, 3, 4, 5, 6])
    np.testing.assert_array_equal(values, [[1, 1, 1, 1, 1], [0, 0, 0, 0, 1]])
