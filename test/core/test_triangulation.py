"""Points from posed views, by hand and against random scenes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from thegra_core.geometry import poses
from thegra_core.geometry.refinement import refine_points
from thegra_core.geometry.triangulation import depths, parallax, reprojection_errors, triangulate, triangulate_views


def test_a_point_by_hand() -> None:
    # cameras at x = 0 and x = 1 see the point (0.5, 0.25, 2) at (0.25, 0.125) and (-0.25, 0.125)
    second = poses.transform(np.eye(3), [-1.0, 0, 0])
    point = triangulate(np.eye(4), second, np.array([[0.25, 0.125]]), np.array([[-0.25, 0.125]]))
    np.testing.assert_allclose(point, [[0.5, 0.25, 2.0]], atol=1e-12)
    np.testing.assert_allclose(depths(second, point), [2.0])
    np.testing.assert_allclose(reprojection_errors(np.eye(4), point, np.array([[0.25, 0.125 + 0.3]])), [0.3], atol=1e-12)


def test_depth_is_along_the_axis_of_the_turned_camera() -> None:
    # a camera at (0, 0, 5) that looks back towards the origin
    camera_from_world = poses.inverse(poses.transform(np.diag([-1.0, 1, -1]), [0, 0, 5.0]))
    np.testing.assert_allclose(depths(camera_from_world, np.array([[1.0, 2, 3], [0, 0, 6]])), [2.0, -1.0], atol=1e-12)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**31 - 1), st.integers(2, 6))
def test_exact_views_give_exact_points(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2, -2, 4], [2, 2, 9], (15, 3))
    cameras = np.stack([poses.transform(Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix(), rng.normal(0, 0.5, 3)) for _ in range(count)])
    projected = np.stack([poses.apply(c, points) for c in cameras], axis=1)
    normalized = projected[..., :2] / projected[..., 2:]
    hidden = rng.random((15, count)) < 0.4
    hidden[:, :2] = False
    normalized[hidden] = np.nan
    np.testing.assert_allclose(triangulate_views(cameras, normalized), points, atol=1e-5)


def test_views_without_an_observation_do_not_count() -> None:
    cameras = np.stack([np.eye(4), poses.transform(np.eye(3), [-1.0, 0, 0]), poses.transform(np.eye(3), [0, -1.0, 0])])
    seen = np.array([[[0.25, 0.125], [-0.25, 0.125], [np.nan, np.nan]], [[0.1, 0.1], [np.nan, np.nan], [np.nan, np.nan]]])
    points = triangulate_views(cameras, seen)
    np.testing.assert_allclose(points[0], [0.5, 0.25, 2.0], atol=1e-12)
    assert np.isnan(points[1]).all(), "one ray is no point"


def test_parallel_rays_give_no_point() -> None:
    second = poses.transform(np.eye(3), [-1.0, 0, 0])
    points = triangulate(np.eye(4), second, np.array([[0.2, 0.1], [0.25, 0.125]]), np.array([[0.2, 0.1], [-0.25, 0.125]]))
    assert np.isnan(points[0]).all()
    assert np.isfinite(points[1]).all()
    assert np.isnan(triangulate(np.eye(4), np.eye(4), np.array([[0.2, 0.1]]), np.array([[0.2, 0.1]]))).all()
    assert triangulate(np.eye(4), second, np.empty((0, 2)), np.empty((0, 2))).shape == (0, 3)


def test_parallax_by_hand() -> None:
    left, right = np.array([-1.0, 0, 0]), np.array([1.0, 0, 0])
    points = np.array([[0.0, 0, 1], [0, 0, np.sqrt(3)], [5.0, 0, 0], [0.5, 0, 0], [0.0, 0, 1e6]])
    np.testing.assert_allclose(np.degrees(parallax(left, right, points)), [90, 60, 0, 180, np.degrees(2e-6)], atol=1e-9)


def test_reprojection_behind_the_camera_is_infinitely_wrong() -> None:
    errors = reprojection_errors(np.eye(4), np.array([[0.0, 0, -1], [0, 0, 0], [0, 0, 1]]), np.zeros((3, 2)))
    np.testing.assert_array_equal(errors, [np.inf, np.inf, 0.0])
    assert reprojection_errors(np.eye(4), np.array([[0.0, 0, 1]]), np.full((1, 2), np.nan)) != pytest.approx(0.0)


def test_refined_points_are_those_of_least_reprojection_error() -> None:
    """Points seen in three to five views with noise: exact without noise, and with it no worse than a general optimiser's."""
    from scipy.optimize import least_squares

    rng = np.random.default_rng(2)
    true = np.stack([rng.uniform(-1, 1, 30), rng.uniform(-1, 1, 30), rng.uniform(3, 8, 30)], axis=1)
    cameras = np.stack([poses.inverse(poses.transform(poses.so3_exp(rng.normal(0, 0.1, 3)), rng.normal(0, 0.5, 3))) for _ in range(5)])
    point_index = np.concatenate([np.repeat(i, 3 + i % 3) for i in range(30)])
    views = np.concatenate([np.arange(3 + i % 3) for i in range(30)])
    seen = np.einsum("mij,mj->mi", cameras[views][:, :3, :3], true[point_index]) + cameras[views][:, :3, 3]
    exact = seen[:, :2] / seen[:, 2:]
    start = true + rng.normal(0, 0.2, true.shape)
    points, errors = refine_points(cameras[views], exact, point_index, start, steps=8)
    np.testing.assert_allclose(points, true, atol=1e-6)
    assert errors.max() < 1e-6
    noisy = exact + rng.normal(0, 0.002, exact.shape)
    points, errors = refine_points(cameras[views], noisy, point_index, start, steps=8)
    for i in range(0, 30, 7):
        mine = point_index == i

        def residual(x: np.ndarray, mine: np.ndarray = mine) -> np.ndarray:
            p = np.einsum("mij,j->mi", cameras[views[mine]][:, :3, :3], x) + cameras[views[mine]][:, :3, 3]
            return (p[:, :2] / p[:, 2:] - noisy[mine]).ravel()

        best = least_squares(residual, true[i], xtol=1e-12)
        np.testing.assert_allclose(points[i], best.x, atol=1e-4)
        assert (errors[mine] ** 2).sum() == pytest.approx(2 * best.cost, rel=1e-4)


def test_a_point_behind_a_camera_stays_and_has_infinite_error() -> None:
    cameras = np.stack([np.eye(4), np.eye(4)])
    points, errors = refine_points(cameras, np.zeros((2, 2)), np.array([0, 0]), np.array([[0.0, 0.0, -2.0]]))
    np.testing.assert_array_equal(points, [[0.0, 0.0, -2.0]])
    assert np.isinf(errors).all()
