"""What motion between two views could be: a pure rotation, an essential matrix, or one of a homography's decompositions."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from thegra_core.config import InitializationConfig
from thegra_core.geometry import epipolar, poses, triangulation

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MotionHypothesis:
    """A relative pose camera1_from_camera0 (4, 4), translation of length 1, and the model it came from."""

    camera1_from_camera0: FloatArray
    model: str


def parallax_to_noise(normalized0: FloatArray, normalized1: FloatArray, focal: float, hypotheses: list[MotionHypothesis]) -> tuple[float, float]:
    """How far the matches (N, 2) are from a pure rotation, in px (median) and over what noise alone would give.

    The residual of the best pure rotation is noise plus parallax, the epipolar distance of the best hypothesis noise alone. Isotropic Gaussian noise
    gives medians of 1.177 and 0.674 sigma, a ratio of 1.746, so that the second value is about 1 for a camera that only turns, at any noise level.
    """
    _, errors = epipolar.fit_rotation(normalized0, normalized1, 1.0 / focal)
    flow = focal * float(np.median(errors))
    noise = min(
        (focal * float(np.median(epipolar.sampson_errors(epipolar.essential(h.camera1_from_camera0), normalized0, normalized1))) for h in hypotheses),
        default=np.inf,
    )
    return flow, flow / max(1.746 * noise, 1e-9)


def motion_hypotheses(
    normalized0: FloatArray, normalized1: FloatArray, focal: float, config: InitializationConfig, rng: np.random.Generator
) -> list[MotionHypothesis]:
    """Candidate motions of matches (N, 2), N >= 8: the refined essential matrix and every decomposition of the homography that puts the points in front.

    A plane seen by two views has two motions that explain it alike, so none of the homography's is thrown away here.
    """
    found = []
    motion = _from_essential(normalized0, normalized1, focal, config, rng)
    if motion is not None:
        found.append(MotionHypothesis(motion, "essential"))
    found += [MotionHypothesis(m, "homography") for m in _from_homography(normalized0, normalized1, focal, config)]
    return found


def _from_essential(
    normalized0: FloatArray, normalized1: FloatArray, focal: float, config: InitializationConfig, rng: np.random.Generator
) -> FloatArray | None:
    """MAGSAC (Barath 2019), then iterative minimal sets (Rosten 2010) on its inliers, then the sign of the translation by cheirality."""
    camera = np.diag([focal, focal, 1.0])
    pixels0, pixels1 = focal * normalized0, focal * normalized1
    cv2.setRNGSeed(int(rng.integers(2**31 - 1)))
    try:
        matrix, mask = cv2.findEssentialMat(pixels0, pixels1, camera, method=cv2.USAC_MAGSAC, prob=0.9999, threshold=config.magsac_threshold_px)
        if matrix is None or matrix.shape != (3, 3):
            return None
        inliers = mask.ravel() > 0
    except cv2.error:
        return None
    if inliers.sum() < 8:
        return None
    x0, x1 = normalized0[inliers], normalized1[inliers]
    rotation_a, rotation_b, t = cv2.decomposeEssentialMat(matrix)
    candidates = [poses.transform(rotation, sign * t) for rotation in (rotation_a, rotation_b) for sign in (1.0, -1.0)]
    motion = max(candidates, key=lambda m: _in_front(m, x0, x1))
    motion = epipolar.refine_relative_pose(motion, x0, x1, config.magsac_threshold_px / focal, rng)
    opposite = poses.transform(motion[:3, :3], -motion[:3, 3])
    return max((motion, opposite), key=lambda m: _in_front(m, x0, x1))


def _from_homography(normalized0: FloatArray, normalized1: FloatArray, focal: float, config: InitializationConfig) -> list[FloatArray]:
    try:
        homography, mask = cv2.findHomography(focal * normalized0, focal * normalized1, cv2.USAC_MAGSAC, 2.0 * config.magsac_threshold_px, maxIters=5000, confidence=0.9999)
    except cv2.error:
        return []
    if homography is None or not np.all(np.isfinite(homography)):
        return []
    inliers = mask.ravel() > 0
    if inliers.sum() < 8:
        return []
    scale = np.diag([focal, focal, 1.0])
    _, rotations, translations, _ = cv2.decomposeHomographyMat(np.linalg.inv(scale) @ homography @ scale, np.eye(3))
    motions = []
    for rotation, t in zip(rotations, translations, strict=True):
        length = float(np.linalg.norm(t))
        if length > 1e-9 and np.linalg.det(rotation) > 0:
            motion = poses.transform(rotation, t / length)
            if _in_front(motion, normalized0[inliers], normalized1[inliers]) > 0.9 * inliers.sum():
                motions.append(motion)
    return motions


def _in_front(motion: FloatArray, normalized0: FloatArray, normalized1: FloatArray) -> int:
    points = triangulation.triangulate(np.eye(4), motion, normalized0, normalized1)
    with np.errstate(invalid="ignore"):
        return int(((points[:, 2] > 0) & (triangulation.depths(motion, points) > 0)).sum())
