"""Motion-only bundle adjustment: derivatives, robustness, covariance, weights."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from thegra_core.geometry import poses
from thegra_core.optimization.pose import estimate_pose, pose_jacobian, refine_pose

FOCAL = 400.0


def view(seed: int, count: int = 120) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """camera_from_world, points_world, exact normalized coordinates."""
    rng = np.random.default_rng(seed)
    camera_from_world = poses.transform(Rotation.from_rotvec(rng.normal(0, 0.3, 3)).as_matrix(), rng.normal(0, 1, 3))
    points_camera = rng.uniform([-2, -2, 2], [2, 2, 8], (count, 3))
    return camera_from_world, poses.apply(poses.inverse(camera_from_world), points_camera), points_camera[:, :2] / points_camera[:, 2:]


def moved(pose: np.ndarray, delta: np.ndarray) -> np.ndarray:
    return poses.transform(poses.so3_exp(delta[:3]), delta[3:]) @ pose


def difference(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Left perturbation (rotation, translation) that leads from the true pose to the one found."""
    relative = found @ poses.inverse(true)
    return np.concatenate([poses.so3_log(relative[:3, :3]), relative[:3, 3]])


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**31 - 1))
def test_jacobian_is_the_difference_quotient(seed: int) -> None:
    pose, points, _ = view(seed, 6)
    step = 1e-6

    def project(delta: np.ndarray) -> np.ndarray:
        p = poses.apply(moved(pose, delta), points)
        return p[:, :2] / p[:, 2:]

    numeric = np.stack([(project(step * e) - project(-step * e)) / (2 * step) for e in np.eye(6)], axis=2)
    np.testing.assert_allclose(pose_jacobian(poses.apply(pose, points)), numeric, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_the_truth_is_found_among_outliers(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, points, normalized = view(seed)
    normalized = normalized + rng.normal(0, 0.3 / FOCAL, normalized.shape)
    wrong = np.arange(len(points)) < 36
    normalized[wrong] += rng.uniform(20, 60, (36, 2)) * rng.choice([-1, 1], (36, 2)) / FOCAL
    ones = np.ones(len(points))
    found = refine_pose(moved(pose, rng.normal(0, 0.02, 6)), points, normalized, FOCAL, ones)
    np.testing.assert_array_equal(found.inliers[wrong], False)
    assert found.inliers[~wrong].mean() > 0.97
    error = difference(found.camera_from_world, pose)
    assert np.abs(error[:3]).max() < 5e-4 and np.abs(error[3:]).max() < 3e-3


@pytest.mark.parametrize("chi2", [5.991, 96.0])
@pytest.mark.parametrize("seed", range(4))
def test_outliers_do_not_pull_a_good_start_away(seed: int, chi2: float) -> None:
    """A nearly flat scene far away holds a pose only weakly; what is grossly wrong at the start must not push it out of its basin."""
    rng = np.random.default_rng(seed)
    points = np.concatenate([rng.uniform(-6, 6, (120, 2)), rng.uniform(15, 18, (120, 1))], axis=1)
    pose = poses.transform(poses.so3_exp([0.02, -0.01, 0.01]), [0.2, -0.3, 0.2])
    seen = poses.apply(pose, points)
    normalized = seen[:, :2] / seen[:, 2:] + rng.normal(0, 0.3 / FOCAL, (120, 2))
    normalized[:25] = normalized[rng.permutation(25) + 40]
    ones = np.ones(120)
    found = refine_pose(pose, points, normalized, FOCAL, ones, chi2)
    assert found.inliers[25:].mean() > 0.97 and not found.inliers[:25].sum() > 3
    assert np.linalg.norm(difference(found.camera_from_world, pose)[3:]) < 0.2


def test_exact_observations_give_the_exact_pose() -> None:
    pose, points, normalized = view(11)
    ones = np.ones(len(points))
    found = refine_pose(moved(pose, np.full(6, 0.02)), points, normalized, FOCAL, ones)
    np.testing.assert_allclose(found.camera_from_world, pose, atol=1e-9)
    assert found.inliers.all()


def test_covariance_is_what_repetition_shows() -> None:
    """200 noisy repetitions: standard deviations in each direction, and the whole ellipsoid, as predicted."""
    rng = np.random.default_rng(0)
    pose, points, normalized = view(3, 60)
    weights = rng.choice([0.25, 1.0, 4.0], 60)
    errors, predicted = [], []
    for _ in range(200):
        noisy = normalized + rng.normal(0, 0.5 / FOCAL, normalized.shape) / np.sqrt(weights)[:, None]
        found = refine_pose(pose, points, noisy, FOCAL, weights, 1e4)
        errors.append(difference(found.camera_from_world, pose))
        predicted.append(found.covariance)
    deviation, expected = np.std(errors, axis=0), np.sqrt(np.diag(np.mean(predicted, axis=0)))
    assert (deviation < 1.25 * expected).all() and (expected < 1.25 * deviation).all()
    mahalanobis = [e @ np.linalg.solve(c, e) for e, c in zip(errors, predicted, strict=True)]
    assert np.mean(mahalanobis) == pytest.approx(6.0, rel=0.2)
    np.testing.assert_allclose(predicted[0], predicted[0].T, atol=1e-15)


def test_weights_give_the_minimum_of_the_weighted_cost() -> None:
    rng = np.random.default_rng(1)
    pose, points, normalized = view(5, 30)
    normalized = normalized + rng.normal(0, 0.8 / FOCAL, normalized.shape)
    weights, open_gate = rng.uniform(0.2, 4.0, 30), 1e6

    def cost(delta: np.ndarray, start: np.ndarray, w: np.ndarray) -> float:
        p = poses.apply(moved(start, delta), points)
        return float((w * ((FOCAL * (p[:, :2] / p[:, 2:] - normalized)) ** 2).sum(axis=1)).sum())

    found = refine_pose(pose, points, normalized, FOCAL, weights, open_gate).camera_from_world
    best = minimize(cost, np.zeros(6), args=(found, weights), method="BFGS").fun
    assert cost(np.zeros(6), found, weights) == pytest.approx(best, rel=1e-6)
    unweighted = refine_pose(pose, points, normalized, FOCAL, np.ones(30), open_gate).camera_from_world
    assert cost(np.zeros(6), unweighted, weights) > 1.001 * best
    assert cost(np.zeros(6), found, np.ones(30)) > cost(np.zeros(6), unweighted, np.ones(30))


def test_gate_is_on_the_pixels_whatever_the_weights() -> None:
    pose, points, normalized = view(6, 40)
    off = normalized.copy()
    off[0, 0] += 4.0 / FOCAL  # the pose gives way a little: about 3.8 px are left
    ones = np.ones(40)
    assert not refine_pose(pose, points, off, FOCAL, ones).inliers[0]
    assert not refine_pose(pose, points, off, FOCAL, 0.01 * ones).inliers[0]
    assert refine_pose(pose, points, off, FOCAL, ones, chi2=20.0).inliers[0]


def test_hopeless_input_gives_no_inliers_and_finite_numbers() -> None:
    pose, points, normalized = view(7, 10)
    behind = poses.transform(np.diag([-1.0, 1.0, -1.0]), [0, 0, 0]) @ pose
    for start, p, n in ((behind, points, normalized), (pose, points[:2], normalized[:2]), (pose, points[:0], normalized[:0])):
        ones = np.ones(len(p))
        found = refine_pose(start, p, n, FOCAL, ones)
        assert np.isfinite(found.camera_from_world).all() and np.isfinite(found.covariance).all()
    assert not refine_pose(behind, points, normalized, FOCAL, np.ones(10)).inliers.any()


def test_an_undefined_observation_does_not_spoil_the_pose() -> None:
    pose, points, normalized = view(8, 40)
    normalized[3] = np.nan
    found = refine_pose(pose, points, normalized, FOCAL, np.ones(40))
    assert np.isfinite(found.camera_from_world).all()
    assert not found.inliers[3] and found.inliers.sum() == 39


@pytest.mark.parametrize("seed", range(5))
def test_a_pose_without_a_start(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, points, normalized = view(20 + seed)
    normalized = normalized + rng.normal(0, 0.3 / FOCAL, normalized.shape)
    normalized[:40] = rng.uniform(-0.7, 0.7, (40, 2))
    found, inliers = estimate_pose(points, normalized, FOCAL, 4.0, seed=0)
    assert 80 <= inliers <= 90
    error = difference(found, pose)
    assert np.abs(error[:3]).max() < 2e-3 and np.abs(error[3:]).max() < 1e-2
    again, _ = estimate_pose(points, normalized, FOCAL, 4.0, seed=0)
    np.testing.assert_array_equal(found, again)


def test_too_few_or_contradicting_points_give_no_pose() -> None:
    rng = np.random.default_rng(0)
    _, points, normalized = view(2)
    _, inliers = estimate_pose(points, rng.uniform(-0.7, 0.7, normalized.shape), FOCAL, 2.0, seed=0)
    assert inliers < 15
    for count in (0, 1, 3):
        pose, inliers = estimate_pose(points[:count], normalized[:count], FOCAL, 4.0, seed=0)
        assert inliers <= count and np.isfinite(pose).all()
