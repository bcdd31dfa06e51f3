"""Two-view geometry: by hand, against known motions, and against poselib."""

from __future__ import annotations

import numpy as np
import poselib
import pytest
from scipy.spatial.transform import Rotation

from thegra_core.geometry import epipolar, poses

FOCAL = 400.0


def scene(seed: int, count: int = 150, noise_px: float = 0.0, outliers: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """camera1_from_camera0 with a unit translation, and both views of random points."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(rng.normal(0, 0.12, 3)).as_matrix()
    direction = rng.normal(size=3)
    motion = poses.transform(rotation, direction / np.linalg.norm(direction))
    points = rng.uniform([-3, -3, 4], [3, 3, 10], (count, 3))
    moved = poses.apply(motion, points)
    x0, x1 = points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]
    x0 = x0 + rng.normal(0, noise_px / FOCAL, x0.shape)
    x1 = x1 + rng.normal(0, noise_px / FOCAL, x1.shape)
    wrong = rng.random(count) < outliers
    x1[wrong] = rng.uniform(-0.7, 0.7, (int(wrong.sum()), 2))
    return motion, x0, x1


def angles(found: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Errors in degrees: of the rotation, of the direction of translation."""
    rotation = poses.rotation_angle(found[:3, :3].T @ true[:3, :3])
    cosine = found[:3, 3] @ true[:3, 3] / np.linalg.norm(found[:3, 3]) / np.linalg.norm(true[:3, 3])
    return float(np.degrees(rotation)), float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def test_essential_of_a_sideways_step_by_hand() -> None:
    # t = (1, 0, 0), R = I: y1 must equal y0
    matrix = epipolar.essential(poses.transform(np.eye(3), [2.0, 0, 0]))
    np.testing.assert_allclose(matrix, [[0, 0, 0], [0, 0, -1], [0, 1, 0]])


def test_distances_by_hand() -> None:
    motion = poses.transform(np.eye(3), [1.0, 0, 0])
    x0, x1 = np.array([[0.2, 0.1], [0.0, 0.0]]), np.array([[0.4, 0.1], [0.3, 0.03]])
    # the algebraic error is y0 - y1, both lines have a normal of length 1: sampson = |dy| / sqrt 2
    np.testing.assert_allclose(epipolar.sampson_errors(epipolar.essential(motion), x0, x1), [0, 0.03 / np.sqrt(2)], atol=1e-15)
    np.testing.assert_allclose(epipolar.epipolar_distances(motion, x0, x1), [0, 0.03], atol=1e-15)


def test_exact_matches_satisfy_the_constraint_and_it_has_a_direction() -> None:
    motion, x0, x1 = scene(1)
    matrix = epipolar.essential(motion)
    assert epipolar.sampson_errors(matrix, x0, x1).max() < 1e-14
    assert epipolar.epipolar_distances(motion, x0, x1).max() < 1e-13
    assert np.median(epipolar.sampson_errors(matrix, x1, x0)) > 1e-3


def test_sampson_does_not_care_for_the_scale_or_order_of_the_views() -> None:
    motion, x0, x1 = scene(2, noise_px=2.0)
    matrix = epipolar.essential(motion)
    expected = epipolar.sampson_errors(matrix, x0, x1)
    np.testing.assert_allclose(epipolar.sampson_errors(-7.0 * matrix, x0, x1), expected, atol=1e-12)
    np.testing.assert_allclose(epipolar.sampson_errors(epipolar.essential(poses.inverse(motion)), x1, x0), expected, atol=1e-12)


def test_homography_of_a_plane_by_hand() -> None:
    # plane z = 2, H = R + t n^T / d with n = (0, 0, 1)
    motion = poses.transform(Rotation.from_rotvec([0.1, -0.05, 0.2]).as_matrix(), [0.3, -0.2, 0.1])
    homography = motion[:3, :3] + np.outer(motion[:3, 3], [0, 0, 0.5])
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3)) * [1, 1, 0] + [0, 0, 2]
    moved = poses.apply(motion, points)
    x0, x1 = points[:, :2] / 2, moved[:, :2] / moved[:, 2:]
    assert epipolar.homography_errors(homography, x0, x1).max() < 1e-12
    np.testing.assert_allclose(epipolar.homography_errors(homography, x0, x1 + np.array([0.03, 0.04])), 0.05, atol=1e-12)
    assert np.isinf(epipolar.homography_errors(-homography, x0, x1)).all()


@pytest.mark.parametrize("seed", range(8))
def test_refinement_of_a_disturbed_motion_is_exact_without_noise(seed: int) -> None:
    motion, x0, x1 = scene(seed)
    start = poses.transform(Rotation.from_rotvec([0.03, -0.02, 0.02]).as_matrix() @ motion[:3, :3], 5 * (motion[:3, 3] + [0.1, -0.1, 0.1]))
    found = epipolar.refine_relative_pose(start, x0, x1, 1.0 / FOCAL, np.random.default_rng(0))
    rotation, direction = angles(found, motion)
    assert rotation < 1e-4 and direction < 1e-3
    assert np.linalg.norm(found[:3, 3]) == pytest.approx(1.0)


def test_refinement_under_noise_and_outliers_improves_the_start_and_keeps_up_with_poselib() -> None:
    camera = {"model": "SIMPLE_PINHOLE", "width": 800, "height": 800, "params": [FOCAL, 0.0, 0.0]}
    before, ours, theirs = [], [], []
    for seed in range(20):
        motion, x0, x1 = scene(100 + seed, noise_px=0.7, outliers=0.3)
        start = poses.transform(Rotation.from_rotvec([0.02, 0.03, -0.02]).as_matrix() @ motion[:3, :3], motion[:3, 3] + [0.1, 0.1, -0.1])
        before.append(angles(start, motion))
        ours.append(angles(epipolar.refine_relative_pose(start, x0, x1, 1.0 / FOCAL, np.random.default_rng(0)), motion))
        pose, _ = poselib.estimate_relative_pose(FOCAL * x0, FOCAL * x1, camera, camera, {"max_epipolar_error": 2.0, "seed": 0}, {})
        theirs.append(angles(poses.transform(pose.R, pose.t), motion))
    assert (np.array(ours) < np.array(before)).all(axis=1).mean() >= 0.9
    assert (np.median(ours, axis=0) < 2 * np.median(theirs, axis=0)).all()


def test_refinement_is_deterministic() -> None:
    motion, x0, x1 = scene(9, noise_px=0.5, outliers=0.2)
    runs = [epipolar.refine_relative_pose(motion, x0, x1, 1.0 / FOCAL, np.random.default_rng(4)) for _ in range(2)]
    np.testing.assert_array_equal(runs[0], runs[1])


def test_refinement_survives_degenerate_matches() -> None:
    rng = np.random.default_rng(0)
    same = np.tile([[0.1, 0.2]], (20, 1))
    still = rng.uniform(-0.5, 0.5, (20, 2))
    for x0, x1 in ((same, same), (still, still), (still[:8], still[:8])):
        found = epipolar.refine_relative_pose(poses.transform(np.eye(3), [1.0, 0, 0]), x0, x1, 1.0 / FOCAL, rng)
        assert np.isfinite(found).all()
        np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("seed", range(10))
def test_pure_rotation_is_found_among_outliers(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix()
    x0 = rng.uniform(-0.6, 0.6, (200, 2))
    turned = epipolar.homogeneous(x0) @ rotation.T
    x1 = turned[:, :2] / turned[:, 2:] + rng.normal(0, 0.5 / FOCAL, (200, 2))
    wrong = np.arange(200) < 60
    x1[wrong] = rng.uniform(-0.6, 0.6, (60, 2))
    found, errors = epipolar.fit_rotation(x0, x1, 2.0 / FOCAL)
    assert np.degrees(poses.rotation_angle(found.T @ rotation)) < 0.1
    assert (FOCAL * errors[~wrong] < 2.0).mean() > 0.99
    assert (FOCAL * errors[wrong] < 2.0).mean() < 0.05


def test_rotation_of_matches_with_parallax_leaves_errors() -> None:
    _, x0, x1 = scene(3)
    _, errors = epipolar.fit_rotation(x0, x1, 2.0 / FOCAL)
    assert (FOCAL * errors < 2.0).mean() < 0.5
