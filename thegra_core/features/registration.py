"""How an image lies over another one as a whole, and following with its help what has moved far."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.registration import phase_cross_correlation

from thegra_core.config import FlowConfig
from thegra_core.features.flow import Followed, Image, Points, follow

FloatArray = NDArray[np.float64]
COARSE = 8
"""Factor by which images shrink to look for the shift that they have as a whole."""
LEAST_OVERLAP = 0.4
"""Of the area of two images that are laid over each other: where less is common, chance agrees better than the truth (measured)."""
LEAST_POINTS = 12
"""That a homography is asked of; it is found from four."""
HOMOGRAPHY_PX = 8.0
"""A homography is that of a plane; what lies before or behind it may be so far off and is still found from there."""
ROUNDS = 2
"""Of straightening, each from what the one before has found."""


def coarse_shift(before: Image, after: Image) -> Points:
    """(2,) float32 px by which most of the image has moved, by phase correlation (Kuglin and Hines 1975) to about the pixels of the small image."""
    small = [image - image.mean() for image in _shrunk(before, after)]
    shift, _ = cv2.phaseCorrelate(small[0], small[1], cv2.createHanningWindow(small[0].shape[::-1], cv2.CV_32F))
    return _in_full_size(shift, before, small[0])


def overlap_shift(before: Image, after: Image) -> Points:
    """As `coarse_shift`, also where images share but half of what they show: the shift at which what they share agrees best (masked normalized correlation,
    Padfield 2012). It takes five times as long, and a camera that comes nearer misleads it."""
    small = _shrunk(before, after)
    whole = np.ones(small[0].shape, bool)
    (down, right), _, _ = phase_cross_correlation(small[1], small[0], reference_mask=whole, moving_mask=whole, overlap_ratio=LEAST_OVERLAP)
    return _in_full_size((right, down), before, small[0])


def follow_far(before: Image, after: Image, points: Points, near: Followed, config: FlowConfig) -> Followed:
    """Points (N, 2) px that were not found well (`near`) sought with more effort: after frames that are missing, a closed shutter, or a quick turn.

    Of two shifts, or none where neither leads anywhere, the one whose points agree best with one homography is taken, and then the first image is laid over the
    second by that: Lucas-Kanade knows shifts only, and an image that is larger, turned or slanted looks alike once it is straightened.
    """
    tried = [(near, *_homography(points, near))]
    for shift in (overlap_shift(before, after), np.zeros(2, np.float32)):
        found = follow(before, after, points, points + shift, config)
        tried.append((found, *_homography(points, found)))
        if max(agreeing for _, _, agreeing in tried) > 0:
            break
    best, homography, agreeing = max(tried, key=lambda item: item[2])
    for _ in range(ROUNDS):
        if homography is None:
            break
        again = _straightened(before, after, points, homography, config)
        homography, agreeing_again = _homography(points, again)
        if agreeing_again <= agreeing:
            break
        best, agreeing = again, agreeing_again
    return best


def _homography(points: Points, known: Followed) -> tuple[FloatArray | None, int]:
    """The homography (3, 3) that most of the points found agree with, and how many do; None and 0 if hardly any."""
    if known.found.sum() < LEAST_POINTS:
        return None, 0
    homography, agreeing = cv2.findHomography(points[known.found], known.points[known.found], cv2.USAC_MAGSAC, HOMOGRAPHY_PX, None, 2000, 0.999)
    if homography is None or not np.isfinite(homography).all() or agreeing.sum() < LEAST_POINTS:
        return None, 0
    return np.asarray(homography, np.float64), int(agreeing.sum())


def _straightened(before: Image, after: Image, points: Points, homography: FloatArray, config: FlowConfig) -> Followed:
    """The points from where the homography puts them, in the image that it makes of the first."""
    height, width = before.shape
    straight: Image = np.asarray(cv2.warpPerspective(before, homography, (width, height), borderValue=128), np.uint8)
    start: Points = np.asarray(cv2.perspectiveTransform(points[None], homography)[0], np.float32)
    inside = np.isfinite(start).all(axis=1) & (start >= config.border).all(axis=1) & (start <= np.array([width, height]) - 1 - config.border).all(axis=1)
    rows = np.flatnonzero(inside)
    found = follow(straight, after, start[rows], start[rows], config)
    result = Followed(start, np.zeros(len(points), bool), np.full(len(points), -1, np.float32))
    result.points[rows], result.found[rows], result.similarity[rows] = found.points, found.found, found.similarity
    return result


def _shrunk(*images: Image) -> list[NDArray[np.float32]]:
    size = [max(side // COARSE, 8) for side in images[0].shape[::-1]]
    return [cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32) for image in images]


def _in_full_size(shift: Sequence[float], image: Image, small: NDArray[np.float32]) -> Points:
    return np.asarray(np.array(shift) * np.array(image.shape[::-1]) / np.array(small.shape[::-1]), np.float32)
