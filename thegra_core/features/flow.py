"""Points followed from one image to the next by pyramidal Lucas-Kanade (Lucas and Kanade 1981, Bouguet 2000), with checks of each."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from thegra_core.config import FlowConfig

Image = NDArray[np.uint8]
Points = NDArray[np.float32]
BoolArray = NDArray[np.bool_]

CONTRAST_WINDOW = 31
"""px; side of the square whose mean and spread a pixel is compared with."""
CONTRAST_LEVELS = 40.0
"""Grey levels of one standard deviation in the normalized image; 3.2 of them fit in 8 bit."""
LEAST_VARIANCE = 25.0
"""Squared grey levels; below this an area is flat, and its noise is not blown up."""
_IMAGE = numba.types.Array(numba.uint8, 2, "C", readonly=True)  # those of messages are
_STEPS = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 20, 0.03)


@dataclass(frozen=True, slots=True)
class Followed:
    """Where points are in the next image: (N, 2) float32 px, whether each was found (N,), and how alike its surroundings look (N,) float32 in [-1, 1]."""

    points: Points
    found: BoolArray
    similarity: NDArray[np.float32]


def normalize_contrast(image: Image) -> Image:
    """(H, W) uint8 without local brightness and contrast: gain control that changes both from frame to frame would be motion to Lucas-Kanade."""
    size = (CONTRAST_WINDOW, CONTRAST_WINDOW)
    image = np.ascontiguousarray(image)
    normalized: Image = np.empty_like(image)
    mean, mean_square = (np.asarray(box(image, cv2.CV_32F, size), np.float32) for box in (cv2.boxFilter, cv2.sqrBoxFilter))
    _normalize(image, mean, mean_square, normalized)
    return normalized


@numba.njit(numba.void(_IMAGE, numba.float32[:, ::1], numba.float32[:, ::1], numba.uint8[:, ::1]), cache=True, nogil=True, fastmath=True, error_model="numpy")  # compiled before a camera runs
def _normalize(image: Image, mean: NDArray[np.float32], mean_square: NDArray[np.float32], normalized: Image) -> None:
    middle, levels, least, most = np.float32(128), np.float32(CONTRAST_LEVELS), np.float32(LEAST_VARIANCE), np.float32(255)
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            m = mean[row, column]
            deviation = np.sqrt(max(mean_square[row, column] - m * m, least))
            normalized[row, column] = np.uint8(min(max(middle + levels * (np.float32(image[row, column]) - m) / deviation, np.float32(0)), most))


def follow(before: Image, after: Image, points: Points, start: Points, config: FlowConfig) -> Followed:
    """Find points (N, 2) px of one contrast-normalized image in the next, looking first at `start` (N, 2) px.

    A point counts as found if it lies inside, leads back to where it came from, and looks like it did.
    """
    there, inside = step(before, after, points, start, config)
    return confirmed(before, after, points, there, inside, config)


def step(before: Image, after: Image, points: Points, start: Points, config: FlowConfig) -> tuple[Points, BoolArray]:
    """The first part of `follow`: where points (N, 2) px may be, and which (N,) lie inside."""
    if len(points) == 0:
        return np.empty((0, 2), np.float32), np.empty(0, bool)
    window = (config.window, config.window)
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, np.array(start, np.float32, order="C"), winSize=window, maxLevel=config.levels, criteria=_STEPS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    there: Points = np.asarray(moved, np.float32)
    height, width = after.shape
    inside = (there >= config.border).all(axis=1) & (there[:, 0] <= width - 1 - config.border) & (there[:, 1] <= height - 1 - config.border)
    return there, (status.ravel() > 0) & inside


def confirmed(before: Image, after: Image, points: Points, there: Points, asked: BoolArray, config: FlowConfig) -> Followed:
    """The second part of `follow`, for the points that are `asked` (N,) for: the others are not found."""
    result = Followed(there, np.zeros(len(points), bool), np.full(len(points), -1, np.float32))
    rows = np.flatnonzero(asked)
    if len(rows) == 0:
        return result
    window, origin = (config.window, config.window), np.ascontiguousarray(points[rows], np.float32)
    back, status, _ = cv2.calcOpticalFlowPyrLK(
        after, before, there[rows], origin.copy(), winSize=window, maxLevel=1, criteria=_STEPS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    rows = rows[(status.ravel() > 0) & (np.linalg.norm(back - origin, axis=1) < config.max_back_px)]
    result.similarity[rows] = patch_similarity(before, after, points[rows], there[rows], config.patch)
    result.found[rows] = result.similarity[rows] >= config.min_similarity
    return result


def patch_similarity(before: Image, after: Image, points: Points, there: Points, size: int) -> NDArray[np.float32]:
    """(N,) zero-mean normalized cross-correlation in [-1, 1] of the squares of `size` px around points (N, 2) of two images; 0 where one is flat."""
    a, b = _patches(before, points, size), _patches(after, there, size)
    a -= a.mean(axis=1, keepdims=True)
    b -= b.mean(axis=1, keepdims=True)
    norms = np.sqrt((a * a).sum(axis=1) * (b * b).sum(axis=1))
    return np.asarray((a * b).sum(axis=1) / np.maximum(norms, 1e-6), np.float32)


def _patches(image: Image, points: Points, size: int) -> NDArray[np.float32]:
    """(N, size * size) values around points, between pixels by bilinear interpolation, beyond the border those of the border."""
    offsets = np.arange(size, dtype=np.float32) - (size - 1) / 2
    x = (points[:, 0, None, None] + offsets[None, None, :]).repeat(size, axis=1).reshape(len(points), size * size)
    y = (points[:, 1, None, None] + offsets[None, :, None]).repeat(size, axis=2).reshape(len(points), size * size)
    if len(points) == 0:
        return np.empty((0, size * size), np.float32)
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
