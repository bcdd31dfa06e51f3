"""The motion model by hand."""

from __future__ import annotations

import numpy as np

from thegra_core.geometry import poses
from thegra_core.geometry.similarity import Similarity
from thegra_core.tracking.motion import MotionModel


def test_motion_model_by_hand() -> None:
    model = MotionModel()
    assert model.predict(5) is None and model.twist() is None
    first = poses.transform(np.eye(3), [1.0, 0, 0])
    model.update(1_000_000_000, first)
    np.testing.assert_array_equal(model.predict(2_000_000_000), first)
    turn = poses.transform(poses.so3_exp([0, 0, 0.2]), [0.5, 0, 0])
    model.update(1_500_000_000, first @ turn)
    predicted = model.predict(2_000_000_000)
    np.testing.assert_allclose(predicted[:3, :3], poses.so3_exp([0, 0, 0.4]), atol=1e-12)
    np.testing.assert_allclose(predicted[:3, 3], [2.0, 0, 0])
    np.testing.assert_allclose(model.twist(), [0, 0, 0.4, 1.0, 0, 0], atol=1e-12)
    model.move(Similarity(poses.transform(np.eye(3), [0, 10.0, 0])))
    np.testing.assert_allclose(model.predict(1_500_000_000)[:3, 3], [1.5, 10, 0], atol=1e-12)
    np.testing.assert_allclose(model.twist(), [0, 0, 0.4, 1.0, 0, 0], atol=1e-12)
    assert model.predicted_covariance(2_000_000_000) is None
    covariance = np.diag([0.0, 0, 3, 4, 5, 6]) * 1e-4
    model.update(2_000_000_000, model.predict(2_000_000_000), covariance)
    np.testing.assert_allclose(model.predicted_covariance(2_000_000_000), covariance, atol=1e-12)
    later = model.predicted_covariance(2_500_000_000)
    np.testing.assert_allclose(np.diag(later)[2], 3e-4 + 0.2**2, atol=1e-9)
    np.testing.assert_allclose(np.diag(later)[5], 6e-4 + 0.5**2, atol=1e-9)
    assert (model.since(2_500_000_000), MotionModel().since(0)) == (0.5, np.inf)
    model.reset()
    assert model.predict(5) is None
