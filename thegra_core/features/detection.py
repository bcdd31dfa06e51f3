"""From a dense score map to keypoints. OpenCV's morphology takes a millisecond where a network library's pooling takes a hundred."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Scores = NDArray[np.float32]


def suppress(scores: Scores, radius: int, rounds: int = 2) -> Scores:
    """Scores (H, W) >= 0 with everything but local maxima of a (2 radius + 1) square set to zero.

    After the first pass the neighbourhoods of the maxima are cleared and maxima of what is left are added, `rounds` times, so that a point beside a
    suppressed one is not lost with it.
    """
    square = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    peaks = scores == cv2.dilate(scores, square)
    for _ in range(rounds):
        near = cv2.dilate(peaks.astype(np.uint8), square) > 0
        left = np.where(near, np.float32(0), scores)
        peaks |= (left == cv2.dilate(left, square)) & ~near
    return np.where(peaks, scores, np.float32(0))


def strongest(peaks: Scores, count: int, threshold: float, border: int) -> tuple[NDArray[np.int64], Scores]:
    """The `count` highest of the positive values of (H, W) above `threshold`, at least `border` px inside.

    Returns:
        keypoints (N, 2) (x, y) whole pixels and their values (N,), highest first, ties in raster order.
    """
    height, width = peaks.shape
    rows, columns = np.nonzero(peaks[border : height - border, border : width - border] > threshold)
    rows, columns = rows + border, columns + border
    values = peaks[rows, columns]
    order = np.argsort(-values, kind="stable")[:count]
    return np.stack((columns[order], rows[order]), axis=1), values[order]


def centroids(scores: Scores, keypoints: NDArray[np.int64]) -> Scores:
    """Keypoints (N, 2) moved to the centre of mass of the scores of the 3x3 pixels around them; they must lie 1 px inside the map."""
    step = np.arange(-1, 2)
    x, y = keypoints[:, 0, None, None], keypoints[:, 1, None, None]
    masses = scores[y + step[:, None], x + step].astype(np.float64)
    total = masses.sum(axis=(1, 2))
    shift = np.stack(((masses * step).sum(axis=(1, 2)), (masses * step[:, None]).sum(axis=(1, 2))), axis=1) / total[:, None]
    return np.asarray(keypoints + shift, np.float32)
