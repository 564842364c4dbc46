import numpy as np
import pytest
from scipy import stats

from experiments.reporting.curve_means import count_changes, mean_curve, resample_curves


def held(curve, step):
    """Return the value of a curve at a step by a search from its start; None outside of it."""
    steps, values = curve
    if not steps[0] <= step <= steps[-1]:
        return None
    return [value for at, value in zip(steps, values, strict=True) if at <= step][-1]


def curves_of(lengths, seed=0):
    """Return made-up curves with these numbers of values, at steps of their own."""
    draw = np.random.default_rng(seed)
    return [(np.cumsum(draw.integers(1, 9, n)), draw.normal(size=n)) for n in lengths]


@pytest.mark.parametrize("points", [3, 40, 10_000])
def test_resample_curves_values_equal_a_search_in_each_curve(points):
    curves = curves_of([90, 3, 60, 1])
    steps, values = resample_curves(curves, points)
    assert (np.diff(steps) > 0).all()
    for curve, row in zip(curves, values, strict=True):
        expected = [held(curve, step) for step in steps]
        np.testing.assert_array_equal(row, np.array(expected, float))


def test_resample_curves_spans_the_longest_curve_and_holds_every_end():
    curves = curves_of([2885, 80, 2000])
    steps, values = resample_curves(curves)
    assert steps[-1] == max(own[-1] for own, _ in curves)
    assert steps[0] == min(own[0] for own, _ in curves)
    assert len(steps) <= 500 + 3 * 3
    for (own, _), row in zip(curves, values, strict=True):
        there = steps[np.isfinite(row)]
        assert (there[0], there[-1]) == (own[0], own[-1])


def test_resample_curves_few_steps_keeps_every_value():
    curves = [(1000 * steps, values) for steps, values in curves_of([100, 50])]
    steps, values = resample_curves(curves)
    for (own, value), row in zip(curves, values, strict=True):
        np.testing.assert_array_equal(row[np.isin(steps, own)], value)


def test_mean_curve_seeds_of_unequal_length_is_the_mean_of_those_that_run():
    curves = curves_of([40, 5, 20])
    steps, values = resample_curves(curves)
    mean = mean_curve(values)
    for i, step in enumerate(steps):
        there = [value for curve in curves if (value := held(curve, step)) is not None]
        assert mean.seeds[i] == len(there)
        assert mean.mean[i] == pytest.approx(np.mean(there), rel=1e-12)
        if len(there) < 2:
            assert np.isnan([mean.low[i], mean.high[i]]).all()
            continue
        expected = stats.bootstrap(
            (np.array(there),), np.mean, n_resamples=2000, method="percentile",
            rng=np.random.default_rng(0),
        ).confidence_interval  # fmt: skip
        np.testing.assert_allclose([mean.low[i], mean.high[i]], expected, rtol=1e-12)


def test_mean_curve_short_bad_seed_does_not_cut_the_long_good_one():
    long, short = (np.arange(0, 577, 1), np.full(577, 0.92)), (np.arange(17), np.zeros(17))
    steps, values = resample_curves([long, short])
    mean = mean_curve(values)
    assert steps[-1] == 576
    np.testing.assert_array_equal(mean.seeds, np.where(steps <= 16, 2, 1))
    np.testing.assert_allclose(mean.mean, np.where(steps <= 16, 0.46, 0.92))
    fall, rise = count_changes(mean.seeds)
    assert (list(steps[fall]), list(rise)) == ([16], [])


def test_mean_curve_of_one_seed_is_that_seed():
    for points in (7, 500):
        _, values = resample_curves(curves_of([90]), points)
        np.testing.assert_array_equal(mean_curve(values).mean, values[0])


def test_mean_curve_gap_between_two_seeds_has_no_mean():
    steps, values = resample_curves([([0, 2], [1, 1]), ([5, 8], [3, 3])])
    mean = mean_curve(values)
    np.testing.assert_array_equal(steps, [0, 2, 3, 5, 8])
    np.testing.assert_array_equal(mean.mean, [1, 1, np.nan, 3, 3])
    np.testing.assert_array_equal(mean.seeds, [1, 1, 0, 1, 1])
