"""The pose from few landmarks and many matches without one, against exact geometry."""

from __future__ import annotations

import numpy as np

from thegra_core.geometry import epipolar, poses
from thegra_core.optimization import hybrid
from thegra_core.optimization.hybrid import LandmarkView, SharedView, estimate_hybrid_pose, refine_hybrid_pose

FOCAL = 400.0
TRUE = poses.inverse(poses.transform(poses.so3_exp([0.05, 0.4, -0.1]), [0.8, -0.1, 0.2]))
KEYFRAMES = (np.eye(4), poses.inverse(poses.transform(poses.so3_exp([0.0, 0.1, 0.0]), [-0.3, 0.1, 0.0])))


def project(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    camera = poses.apply(pose, points)
    return camera[:, :2] / camera[:, 2:]


def scene(landmarks: int, matches: int, noise_px: float = 0.5, wrong: float = 0.0, seed: int = 0) -> tuple[LandmarkView, list[SharedView]]:
    """Points in front of all cameras; `wrong` of the landmarks and of the matches lie anywhere."""
    rng = np.random.default_rng(seed)

    def cloud(count: int) -> np.ndarray:
        return np.stack([rng.uniform(0, 5, count), rng.uniform(-1.5, 1.5, count), rng.uniform(4, 9, count)], axis=1)

    def seen(pose: np.ndarray, points: np.ndarray, spoil: bool) -> np.ndarray:
        pixels = project(pose, points) + rng.normal(0, noise_px / FOCAL, (len(points), 2))
        bad = int(wrong * len(points)) if spoil else 0
        pixels[:bad] = rng.uniform(-0.6, 0.6, (bad, 2))
        return pixels

    def ones(count: int) -> np.ndarray:
        return np.ones(count)

    points = cloud(landmarks)
    view = LandmarkView(points, seen(TRUE, points, True), ones(landmarks))
    shared = []
    for keyframe in KEYFRAMES:
        others = cloud(matches)
        shared.append(SharedView(keyframe, seen(keyframe, others, False), seen(TRUE, others, True), ones(matches)))
    return view, shared


def errors(pose: np.ndarray) -> tuple[float, float]:
    """Degrees of rotation, and distance of the centres."""
    difference = poses.inverse(TRUE) @ pose
    return float(np.degrees(poses.rotation_angle(difference[:3, :3]))), float(np.linalg.norm(poses.inverse(pose)[:3, 3] - poses.inverse(TRUE)[:3, 3]))


def test_exact_observations_give_the_exact_pose() -> None:
    view, shared = scene(8, 60, noise_px=0.0)
    start = estimate_hybrid_pose(view, shared, FOCAL, 4.0, seed=0)
    assert start is not None
    estimate = refine_hybrid_pose(start, view, shared, FOCAL, 5.991)
    np.testing.assert_allclose(estimate.camera_from_world, TRUE, atol=1e-6)
    assert estimate.inliers.all() and estimate.agreeing_matches == 120


def test_wrong_landmarks_and_matches_are_told_from_the_rest() -> None:
    found = []
    for seed in range(8):
        view, shared = scene(14, 120, noise_px=0.7, wrong=0.3, seed=seed)
        start = estimate_hybrid_pose(view, shared, FOCAL, 4.0, seed=0)
        assert start is not None
        estimate = refine_hybrid_pose(start, view, shared, FOCAL, 5.991)
        found.append(errors(estimate.camera_from_world))
        assert not estimate.inliers[:4].any() and estimate.inliers[4:].sum() >= 8
        for agreeing in estimate.agreeing:
            assert agreeing[:36].mean() < 0.15 and agreeing[36:].mean() > 0.8
    rotation, position = np.median(found, axis=0)
    assert rotation < 0.3 and position < 0.03
    assert np.max(found, axis=0)[0] < 2.0, "a wrong match inside its gate may pull, but not far"


def test_matches_make_the_pose_better_than_landmarks_alone() -> None:
    with_matches, alone = [], []
    for seed in range(10):
        view, shared = scene(8, 100, noise_px=1.0, seed=seed)
        with_matches.append(errors(refine_hybrid_pose(TRUE, view, shared, FOCAL, 1e6).camera_from_world)[0])
        alone.append(errors(refine_hybrid_pose(TRUE, view, [], FOCAL, 1e6).camera_from_world)[0])
    assert np.median(with_matches) < 0.5 * np.median(alone)


def test_covariance_is_that_of_the_errors() -> None:
    """The squared error in units of the covariance has mean 6, over draws of the noise."""
    squared = []
    for seed in range(60):
        view, shared = scene(10, 40, noise_px=1.0, seed=seed)
        estimate = refine_hybrid_pose(TRUE, view, shared, FOCAL, 1e6)
        error = TRUE @ poses.inverse(estimate.camera_from_world)
        vector = np.concatenate([poses.so3_log(error[:3, :3]), error[:3, 3]])
        squared.append(float(vector @ np.linalg.solve(estimate.covariance, vector)))
    assert 4.0 < np.mean(squared) < 9.0


def test_the_jacobian_is_that_of_the_residuals() -> None:
    view, shared = scene(5, 7)
    residuals, weights, jacobian = hybrid._system(TRUE, view, shared, FOCAL)
    assert residuals.shape == weights.shape == (10 + 14,) and jacobian.shape == (24, 6)
    step = np.array([1e-5, -2e-5, 1.5e-5, 2e-5, -1e-5, 3e-5])
    moved, _, _ = hybrid._system(hybrid._moved(TRUE, step), view, shared, FOCAL)
    np.testing.assert_allclose(moved - residuals, jacobian @ step, atol=2e-5)


def test_too_few_landmarks_give_no_pose() -> None:
    view, shared = scene(3, 50)
    assert estimate_hybrid_pose(view, shared, FOCAL, 4.0, seed=0) is None


def test_signed_sampson_errors_change_sign_across_the_line() -> None:
    relative = poses.transform(np.eye(3), [1.0, 0, 0])  # epipolar lines are rows
    essential = epipolar.essential(relative)
    here = np.array([[0.3, 0.01], [0.3, -0.01]])
    found = epipolar.signed_sampson_errors(essential, np.array([[0.1, 0.0], [0.1, 0.0]]), here)
    np.testing.assert_allclose(np.abs(found), 0.01 / np.sqrt(2), rtol=1e-6)
    assert found[0] == -found[1]
