"""Points followed from one image to the next by pyramidal Lucas-Kanade (Lucas and Kanade 1981, Bouguet 2000), with checks of each."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
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
_STEPS = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 20, 0.03)


@dataclass(frozen=True, slots=True)
class Followed:
    """Where points are in the next image: (N, 2) float32 px, whether each was found (N,), and how alike its surroundings look (N,) float32 in [-1, 1]."""

    points: Points
    found: BoolArray
    similarity: NDArray[np.float32]


def normalize_contrast(image: Image) -> Image:
    """(H, W) uint8 without local brightness and contrast: gain control that changes both from frame to frame would be motion to Lucas-Kanade."""
    values = image.astype(np.float32)
    size = (CONTRAST_WINDOW, CONTRAST_WINDOW)
    mean = cv2.boxFilter(values, -1, size)
    variance = cv2.boxFilter(values * values, -1, size) - mean * mean
    scaled = 128 + CONTRAST_LEVELS * (values - mean) / np.sqrt(np.maximum(variance, LEAST_VARIANCE))
    return np.asarray(np.clip(scaled, 0, 255), np.uint8)


def follow(before: Image, after: Image, points: Points, start: Points, config: FlowConfig) -> Followed:
    """Find points (N, 2) px of one contrast-normalized image in the next, looking first at `start` (N, 2) px.

    A point counts as found if it lies inside, leads back to where it came from, and looks like it did.
    """
    if len(points) == 0:
        return Followed(np.empty((0, 2), np.float32), np.empty(0, bool), np.empty(0, np.float32))
    window, use_start = (config.window, config.window), cv2.OPTFLOW_USE_INITIAL_FLOW
    moved, status, _ = cv2.calcOpticalFlowPyrLK(before, after, points, np.array(start, np.float32, order="C"), winSize=window, maxLevel=config.levels, criteria=_STEPS, flags=use_start)
    there: Points = np.asarray(moved, np.float32)
    back, status_back, _ = cv2.calcOpticalFlowPyrLK(after, before, there, points.copy(), winSize=window, maxLevel=1, criteria=_STEPS, flags=use_start)
    found = (status.ravel() > 0) & (status_back.ravel() > 0)
    found &= np.linalg.norm(back - points, axis=1) < config.max_back_px
    height, width = after.shape
    found &= (there >= config.border).all(axis=1) & (there[:, 0] <= width - 1 - config.border) & (there[:, 1] <= height - 1 - config.border)
    similarity = np.full(len(points), -1, np.float32)
    similarity[found] = patch_similarity(before, after, points[found], there[found], config.patch)
    return Followed(there, found & (similarity >= config.min_similarity), similarity)


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
