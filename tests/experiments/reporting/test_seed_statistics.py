import numpy as np
import pytest
from scipy import stats

from experiments.reporting import seed_statistics
from experiments.reporting.seed_statistics import (
    RESAMPLES,
    bootstrap_interval,
    exponential_smoothing,
    interquartile_mean,
    joint_improvement,
    mean_improvement,
    pooled_interquartile_mean,
    probability_of_improvement,
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


def interval_of_scipy(samples, statistic, resamples, **options):
    """Return the percentile interval of scipy.stats.bootstrap, with the seed of the reports."""
    random = np.random.default_rng(0)
    found = stats.bootstrap(
        samples, statistic, n_resamples=resamples, method="percentile", rng=random, **options
    )
    return found.confidence_interval


@pytest.mark.parametrize("shape", [(2,), (5,), (30,), (3, 4), (9, 50)], ids=str)
@pytest.mark.parametrize("statistic", [np.mean, interquartile_mean])
def test_bootstrap_interval_equals_scipy_with_the_same_random_numbers(shape, statistic):
    values = np.random.default_rng(len(shape)).lognormal(size=shape)
    expected = interval_of_scipy((values,), statistic, 2000, axis=0, vectorized=True)
    np.testing.assert_allclose(bootstrap_interval(values, statistic), expected, rtol=1e-12)


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


@pytest.mark.parametrize("tasks", [1, 2, 10])
def test_mean_improvement_equals_scipy_with_the_same_random_numbers(tasks):
    draw = np.random.default_rng(tasks)
    some = lambda: draw.integers(0, 5, draw.integers(2, 9)).astype(float)  # with ties
    pairs = [(some(), some()) for _ in range(tasks)]

    def mean(*samples):
        each = [
            stats.mannwhitneyu(ours, theirs).statistic / (len(ours) * len(theirs))
            for ours, theirs in zip(samples[:tasks], samples[tasks:], strict=True)
        ]
        return np.mean(each)

    samples = [ours for ours, _ in pairs] + [theirs for _, theirs in pairs]
    with np.errstate(invalid="ignore"):  # the p-value of equal values, which nobody reads
        expected = interval_of_scipy(samples, mean, 500, vectorized=False)
        value, interval = mean_improvement(pairs)
        assert value == pytest.approx(mean(*samples), rel=1e-12)
    np.testing.assert_allclose(interval, expected, rtol=1e-12)


def test_mean_improvement_compares_the_runs_of_a_task_once(monkeypatch):
    compared = []
    compare = seed_statistics.compare_pairs
    keep = lambda ours, theirs: compared.append(len(ours)) or compare(ours, theirs)
    monkeypatch.setattr(seed_statistics, "compare_pairs", keep)
    monkeypatch.setattr(stats, "mannwhitneyu", None)  # a test of significance for each resample
    monkeypatch.setattr(stats, "bootstrap", None)
    pairs = [(np.arange(float(n)), np.arange(1.0, 4.0)) for n in (5, 6, 7)]
    assert mean_improvement(pairs)[1] is not None
    assert compared == [5, 6, 7]


def test_pooled_interquartile_mean_equals_a_loop_over_resamples():
    random = np.random.default_rng(5)
    tasks = [random.random(9), random.random(12) ** 3]
    value, (low, high) = pooled_interquartile_mean(tasks)
    assert value == pytest.approx(stats.trim_mean(np.concatenate(tasks), 0.25))
    random = np.random.default_rng(0)
    drawn = [random.integers(0, len(task), (RESAMPLES, len(task))) for task in tasks]
    found = [
        stats.trim_mean(
            np.concatenate([task[rows[k]] for task, rows in zip(tasks, drawn, strict=True)]), 0.25
        )
        for k in range(RESAMPLES)
    ]
    assert (low, high) == pytest.approx(tuple(np.quantile(found, [0.025, 0.975])))


def test_joint_improvement_of_one_method_has_the_rate_of_mean_improvement():
    random = np.random.default_rng(3)
    pairs = [(random.random(20) + 0.2, random.random(25)) for _ in range(3)]
    value, interval = joint_improvement([([ours], theirs) for ours, theirs in pairs])
    expected, other = mean_improvement(pairs)
    assert value == pytest.approx(expected)
    assert interval == pytest.approx(other, abs=0.03)  # other draws of the same bootstrap


def test_joint_improvement_draws_the_compared_runs_once_for_all_methods():
    """Two equal methods without noise of their own: their mean varies as one of them does."""
    theirs = np.random.default_rng(1).random(400)
    ours = np.full(10, 0.5)
    one = joint_improvement([([ours], theirs)], 0.9)
    two = joint_improvement([([ours, ours], theirs)], 0.9)
    assert two[0] == one[0]
    assert two[1][1] - two[1][0] == pytest.approx(one[1][1] - one[1][0], abs=0.006)
    assert one[1][1] - one[1][0] > 0.06  # of independent draws it would be a third less


def test_exponential_smoothing_curve_equals_the_recursion():
    values = np.random.default_rng(4).normal(size=50)
    wanted, last = [], values[0]
    for x in values:
        last = 0.99 * last + 0.01 * x
        wanted.append(last)
    np.testing.assert_allclose(exponential_smoothing(values), wanted)
    assert not len(exponential_smoothing(np.array([])))
