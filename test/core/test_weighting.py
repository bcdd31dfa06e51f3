"""Observation weights by hand (paper Eq. 1)."""

from __future__ import annotations

import numpy as np
import pytest

from thegra_core.optimization.weighting import observation_weights

SCORES = np.array([0.01, 0.1, 0.2, 0.3, 0.9], dtype=np.float32)


def test_paper_is_the_score_squared() -> None:
    np.testing.assert_allclose(observation_weights(SCORES, "paper"), [0.0001, 0.01, 0.04, 0.09, 0.81], rtol=1e-6)


def test_normalized_is_the_clamped_share_of_the_median_squared() -> None:
    # over the median 0.2: 0.05 -> 0.5, 0.5, 1, 1.5, 4.5 -> 2
    np.testing.assert_allclose(observation_weights(SCORES, "normalized"), [0.25, 0.25, 1.0, 2.25, 4.0], rtol=1e-6)


def test_normalized_does_not_depend_on_contrast() -> None:
    np.testing.assert_allclose(observation_weights(SCORES, "normalized"), observation_weights(0.01 * SCORES, "normalized"), rtol=1e-5)


def test_uniform_is_one() -> None:
    np.testing.assert_array_equal(observation_weights(SCORES, "uniform"), np.ones(5))


@pytest.mark.parametrize("weighting", ["paper", "normalized", "uniform"])
def test_edge_cases(weighting: str) -> None:
    assert observation_weights(np.empty(0, np.float32), weighting).shape == (0,)
    assert np.isfinite(observation_weights(np.zeros(4, np.float32), weighting)).all()
    assert observation_weights(SCORES, weighting).dtype == np.float64
