"""One pair of images through a chain and a front end, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from thegra_core.features.protocols import Extractor, Matcher
from thegra_core.geometry import epipolar, poses
from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import BoolArray, FloatArray, Frame
from thegra_core.preprocessing.chain import Chain

MAGSAC_PX = 1.0
RIGHT_PX = 3.0
"""Distance to the true epipolar line up to which a match counts as right."""
GRID = 8
MIN_MATCHES = 8


@dataclass(frozen=True, slots=True)
class PairResult:
    """Counts of one pair: keypoints of both frames' mean, matches, MAGSAC inliers, share of the image's 8x8 cells that hold an inlier.

    epipolar_px (median distance of all matches to the true epipolar line) and right (matches within 3 px of it) are None without ground truth.
    """

    keypoints: float
    matches: int
    inliers: int
    spread: float
    epipolar_px: float | None = None
    right: int | None = None


def measure_pair(
    chain: Chain,
    extractor: Extractor,
    matcher: Matcher,
    first: Frame,
    second: Frame,
    camera: CameraModel,
    second_from_first: FloatArray | None = None,
    seed: int = 0,
) -> PairResult:
    """Extract and match two frames; `second_from_first` (4, 4) is the true motion, where it is known."""
    chain.reset()
    reference = extractor.extract(chain(first.image, first.stamp_ns), first.stamp_ns)
    query = extractor.extract(chain(second.image, second.stamp_ns), second.stamp_ns)
    matches = matcher.match(query, reference)
    keypoints0, keypoints1 = reference.keypoints[matches.indices[:, 1]], query.keypoints[matches.indices[:, 0]]
    normalized0, normalized1 = camera.undistort(keypoints0.astype(np.float64)), camera.undistort(keypoints1.astype(np.float64))
    inliers = _inliers(normalized0, normalized1, camera.focal, seed)
    error = None
    if second_from_first is not None and len(matches):
        error = camera.focal * epipolar.epipolar_distances(second_from_first, normalized0, normalized1)
    return PairResult(
        keypoints=(len(reference) + len(query)) / 2,
        matches=len(matches),
        inliers=int(inliers.sum()),
        spread=_spread(keypoints1[inliers], query.image_size),
        epipolar_px=float(np.nanmedian(error)) if error is not None else None,
        right=int((error < RIGHT_PX).sum()) if error is not None else None,
    )


def true_motion(world_from_first: FloatArray, world_from_second: FloatArray) -> FloatArray:
    """second_from_first (4, 4)."""
    return poses.inverse(world_from_second) @ world_from_first


def _inliers(normalized0: FloatArray, normalized1: FloatArray, focal: float, seed: int) -> BoolArray:
    """Matches that MAGSAC's essential matrix explains (N,)."""
    defined = np.asarray(np.isfinite(normalized0).all(axis=1) & np.isfinite(normalized1).all(axis=1), dtype=bool)
    result = np.zeros(len(defined), dtype=bool)
    if defined.sum() < MIN_MATCHES:
        return result
    cv2.setRNGSeed(seed)
    x0, x1 = focal * normalized0[defined], focal * normalized1[defined]
    matrix, mask = cv2.findEssentialMat(x0, x1, np.diag([focal, focal, 1.0]), method=cv2.USAC_MAGSAC, prob=0.9999, threshold=MAGSAC_PX)
    if matrix is not None and mask is not None:
        result[np.flatnonzero(defined)[mask.ravel() > 0]] = True
    return result


def _spread(keypoints: NDArray[np.float32], image_size: tuple[int, int]) -> float:
    """Share of the cells of an 8x8 grid that hold a keypoint."""
    cells = np.clip((keypoints * GRID / np.asarray(image_size)).astype(int), 0, GRID - 1)
    return len(np.unique(cells[:, 1] * GRID + cells[:, 0])) / GRID**2 if len(cells) else 0.0
