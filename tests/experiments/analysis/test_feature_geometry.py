import numpy as np
import pytest

from experiments.analysis.feature_geometry import (
    COMPARED,
    eigenvalues,
    feature_rank,
    geometry_figures,
    pairwise_distances,
)


def test_eigenvalues_equal_those_of_the_scatter_matrix():
    z = np.random.default_rng(0).normal(size=(40, 6)) @ np.diag([5, 3, 2, 1, 0.5, 0.1])
    wanted = np.linalg.eigvalsh(39 * np.cov(z.T))[::-1]
    np.testing.assert_allclose(eigenvalues(z.astype(np.float32)), wanted, rtol=1e-4)


def test_feature_rank_counts_independent_dimensions():
    z = np.random.default_rng(1).normal(size=(50, 4))
    assert feature_rank(z) == 4
    assert feature_rank(np.concatenate([z, z[:, :2] @ np.ones((2, 3))], axis=1)) == 4


def test_feature_rank_features_rounded_to_float32_is_unchanged():
    draw = np.random.default_rng(4)
    z = (draw.normal(size=(300, 5)) @ draw.normal(size=(5, 64))).astype(np.float32)
    assert feature_rank(z) == 5


def test_pairwise_distances_equal_a_loop_over_pairs():
    x = np.random.default_rng(2).normal(size=(5, 2, 3))
    wanted = [[np.sqrt(((a - b) ** 2).sum()) for b in x] for a in x]
    np.testing.assert_allclose(pairwise_distances(x), wanted, atol=1e-12)


def test_geometry_figures_four_states_equal_values_by_hand():
    z = np.array([[0.0, 0.0], [3.0, 4.0], [0.0, 0.0], [0.0, 2.0]])
    found = geometry_figures(
        z, np.array([True, False, True])
    )  # the second step crosses the end of an episode
    assert (found["step_mean"], found["step_std"]) == (3.5, 1.5)
    assert found["norm_mean"] == pytest.approx(7 / 4)
    assert (found["rank"], found["d"]) == (2, 2)
    assert found["q50"] == pytest.approx(np.median(eigenvalues(z)))


def test_geometry_figures_more_than_1000_states_uses_only_the_first_1000():
    z = np.random.default_rng(3).normal(size=(COMPARED + 500, 3))
    follows = np.ones(len(z) - 1, bool)
    all_of_them, first = (
        geometry_figures(z, follows),
        geometry_figures(z[:COMPARED], follows[: COMPARED - 1]),
    )
    assert all_of_them == first
