"""Points that their views do not tell where they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thegra_core.geometry import poses
from thegra_core.optimization.bundle import BundleProblem, bundle_adjust
from thegra_core.optimization.undetermined import undetermined


def seen_from(*centers: tuple[float, float, float]) -> np.ndarray:
    """camera_from_world (K, 4, 4) of cameras that look along z."""
    return np.stack([poses.transform(np.eye(3), -np.array(center)) for center in centers])


@pytest.mark.parametrize(
    ("baseline", "told"),
    [(1.0, True), (0.01, True), (1e-4, False), (0.0, False)],
    ids=["22 degrees", "quarter of a degree", "thousandths of a degree", "one place"],
)
def test_two_rays_tell_a_point_by_their_angle(baseline: float, told: bool) -> None:
    views = seen_from((0, 0, 0), (baseline, 0, 0))
    found = undetermined(views, np.array([[0.1, 0.2, 2.5]]), np.array([0, 1]), np.array([0, 0]))
    assert found.tolist() == [not told]


def test_one_view_or_none_tells_nothing() -> None:
    found = undetermined(seen_from((0, 0, 0), (1, 0, 0)), np.array([[0, 0, 2.0], [0, 0, 2.0]]), np.array([0]), np.array([0]))
    assert found.tolist() == [True, True]


def test_a_point_in_a_camera_is_told_by_no_number_of_views() -> None:
    views = seen_from((0, 0, 0), (1, 0, -2), (0, 1, -2))
    points = np.array([[1e-5, 0, 1e-5], [0.1, 0.1, 2.0]])
    found = undetermined(views, points, np.array([0, 1, 2] * 2), np.array([0, 0, 0, 1, 1, 1]))
    assert found.tolist() == [True, False]


@pytest.mark.parametrize("solver", ["gtsam", "schur"])
def test_such_a_point_keeps_nothing_from_being_adjusted(solver: str) -> None:
    """Without the test gtsam returns all as it was: its linear systems are indeterminate whatever their damping."""
    rng = np.random.default_rng(3)
    centers = [(0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.5, 0.0), (0.5, 0.5, 0.1)]
    truth = np.linalg.inv(seen_from(*centers))
    points = rng.uniform([-1, -1, 3], [1, 1, 5], (30, 3))
    view, point = (a.ravel() for a in np.meshgrid(np.arange(4), np.arange(30), indexing="ij"))
    seen = np.stack([poses.apply(poses.inverse(pose), points) for pose in truth])[view, point]
    start = truth.copy()
    start[1:, :3, 3] += rng.normal(0, 0.01, (3, 3))
    inside = start[3, :3, 3] + np.array([3e-5, 1e-5, 7e-5])  # in the last camera's centre
    towards = poses.apply(poses.inverse(start[0]), inside)
    problem = BundleProblem(
        start, np.array([True, True, False, False]), np.vstack((points, inside)), np.append(view, [3, 0]), np.append(point, [30, 30]),
        np.vstack((seen[:, :2] / seen[:, 2:], [3 / 7, 1 / 7], towards[:2] / towards[2])), np.ones(len(view) + 2), 400.0,
    )  # fmt: skip
    problem = replace(problem, world_from_camera=np.where(problem.fixed[:, None, None], truth, start))
    result = bundle_adjust(problem, 2.447, 5.991, 30, 1e-9, solver)
    np.testing.assert_allclose(result.world_from_camera, truth, atol=1e-5)
