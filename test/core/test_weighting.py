"""Observation weights by hand (paper Eq. 1)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thegra_core.optimization.weighting import landmark_weights, observation_weights

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


def test_landmark_weights_by_hand() -> None:
    """Three landmarks seen twice (four dimensions each) with squared errors of 1, 4 and 1 px^2: the median variance of a coordinate is 1/2 px^2."""
    errors, landmarks = np.array([1.0, 1, 4, 4, 1, 1]), np.array([0, 0, 1, 1, 2, 2])
    weights = landmark_weights(errors, landmarks, np.ones(6, bool), 3, freedom=4.0)
    np.testing.assert_allclose(weights, [1, 1, 8 / 20, 8 / 20, 1, 1])


def test_what_is_not_used_tells_no_variance_and_shares_the_landmarks_weight() -> None:
    errors, landmarks = np.array([1.0, 1, 1, 1, np.inf]), np.array([0, 0, 1, 1, 1])
    np.testing.assert_allclose(landmark_weights(errors, landmarks, errors < 6, 3, 4.0), np.ones(5))


def test_without_errors_all_landmarks_are_alike() -> None:
    np.testing.assert_array_equal(landmark_weights(np.zeros(4), np.array([0, 0, 1, 1]), np.ones(4, bool), 2, 4.0), np.ones(4))
    np.testing.assert_array_equal(landmark_weights(np.ones(4), np.array([0, 0, 1, 1]), np.zeros(4, bool), 2, 4.0), np.ones(4))


@given(seed=st.integers(0, 1000), freedom=st.floats(0.5, 20), scale=st.floats(0.01, 100))
def test_landmark_weights_depend_on_no_unit_and_fall_with_the_errors(seed: int, freedom: float, scale: float) -> None:
    rng = np.random.default_rng(seed)
    landmarks = np.repeat(np.arange(9), 3)
    errors = rng.exponential(1.0, 27)
    weights = landmark_weights(errors, landmarks, np.ones(27, bool), 9, freedom)
    np.testing.assert_allclose(landmark_weights(scale * errors, landmarks, np.ones(27, bool), 9, freedom), weights, rtol=1e-9)
    by_error = np.argsort(errors.reshape(9, 3).sum(axis=1))
    assert np.all(np.diff(weights[::3][by_error]) <= 0)
    assert weights.max() <= (freedom + 6) / freedom
