"""Motion-only bundle adjustment: the pose of one camera against fixed points (paper Sec. III-C, ORB-SLAM3's PoseOptimization)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import poselib
from numpy.typing import NDArray

from thegra_core.geometry import poses, triangulation
from thegra_core.optimization.gauss_newton import minimize_reprojection

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
ROUNDS = 4
RANSAC_THRESHOLD_PX = 4.0
"""Inlier threshold of a first pose: wide, since the map's points carry their own error; refinement gates at the chi-square limit."""
GROSS = 16.0
"""Times the gate, or the median if that is more: squared errors at the start that are no error of the start."""


@dataclass(frozen=True, slots=True)
class PoseEstimate:
    """camera_from_world (4, 4); inliers (N,) bool of the observations given; covariance (6, 6) rotation first, of a perturbation in the camera frame."""

    camera_from_world: FloatArray
    inliers: BoolArray
    covariance: FloatArray


def pose_jacobian(points_camera: FloatArray) -> FloatArray:
    """Derivatives (N, 2, 6) of the projections x/z, y/z by a left perturbation (rotation vector, translation) of camera_from_world."""
    x, y, z = points_camera.T
    inverse_z = 1.0 / z
    u, v = x * inverse_z, y * inverse_z
    zero = np.zeros_like(u)
    return np.stack(
        [
            np.stack([-u * v, 1 + u * u, -v, inverse_z, zero, -u * inverse_z], axis=1),
            np.stack([-(1 + v * v), u * v, u, zero, inverse_z, -v * inverse_z], axis=1),
        ],
        axis=1,
    )


def refine_pose(
    camera_from_world: FloatArray,
    points_world: FloatArray,
    normalized: FloatArray,
    focal: float,
    weights: FloatArray,
    chi2: float = 5.991,
) -> PoseEstimate:
    """Least robust weighted reprojection error over one pose.

    Four rounds of at most ten Gauss-Newton steps; after each, observations beyond the gate sit out the next round, grossly wrong ones the first; the
    Huber kernel is off in the last.
    points_world (N, 3); normalized (N, 2) undistorted; focal in px turns their differences into pixels; weights (N,) 1/px^2; chi2
    (px^2) limits squared pixel residuals, whatever the weights. Undefined (NaN) observations are outliers.
    """
    pose = np.ascontiguousarray(camera_from_world)
    start = (focal * triangulation.reprojection_errors(pose, points_world, normalized)) ** 2
    finite = start[np.isfinite(start)]
    inliers: BoolArray = start < GROSS * max(chi2, float(np.median(finite)) if len(finite) else np.inf)
    hessian = np.eye(6)
    for round_index in range(ROUNDS):
        robust = round_index < ROUNDS - 1
        pose, hessian = minimize_reprojection(pose, points_world[inliers], normalized[inliers], focal, weights[inliers], np.sqrt(chi2) if robust else np.inf)
        squared = (focal * triangulation.reprojection_errors(pose, points_world, normalized)) ** 2
        inliers = squared < chi2
        if inliers.sum() < 4:
            break
    count = int(inliers.sum())
    squared = (focal * triangulation.reprojection_errors(pose, points_world[inliers], normalized[inliers])) ** 2
    variance = float((weights[inliers] * squared).sum() / max(2 * count - 6, 1)) if count else 1.0
    covariance = np.asarray(max(variance, 1e-12) * np.linalg.pinv(hessian, hermitian=True), dtype=np.float64)
    return PoseEstimate(pose, inliers, covariance)


def estimate_pose(points_world: FloatArray, normalized: FloatArray, focal: float, threshold_px: float, seed: int) -> tuple[FloatArray, int]:
    """camera_from_world (4, 4) without a starting pose, and its number of inliers, by PoseLib's locally optimised RANSAC (P3P).

    points_world (N, 3), normalized (N, 2) undistorted. 0 inliers: no pose found, as always with less than 4 points.
    """
    if len(points_world) < 4:
        return np.eye(4), 0
    size = float(2 * focal * (np.abs(normalized).max() + 1))
    camera = {"model": "SIMPLE_PINHOLE", "width": int(size), "height": int(size), "params": [focal, 0.0, 0.0]}
    options = {"max_reproj_error": threshold_px, "seed": seed, "min_iterations": 100, "max_iterations": 2000, "success_prob": 0.9999}
    found, info = poselib.estimate_absolute_pose(focal * normalized, points_world, camera, options, {})
    pose = poses.transform(found.R, found.t)
    if not np.all(np.isfinite(pose)):
        return np.eye(4), 0
    return pose, int(info["num_inliers"])
