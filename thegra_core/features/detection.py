"""From a dense score map to keypoints. OpenCV's morphology takes a millisecond where a network library's pooling takes a hundred."""

from __future__ import annotations

from typing import Any

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


def strict_maxima(scores: Scores, radius: int, threshold: float) -> NDArray[np.int64]:
    """(N, 2) (x, y) whole pixels, in raster order, of the values of (H, W) above `threshold` that are higher than all others of the (2 radius + 1) square around them,
    which has to lie inside."""
    others = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    others[radius, radius] = 0
    inside = np.s_[radius:-radius, radius:-radius]
    rows, columns = np.nonzero((scores[inside] > np.asarray(cv2.dilate(scores, others))[inside]) & (scores[inside] > threshold))
    return np.stack((columns + radius, rows + radius), axis=1)


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


def spread(keypoints: NDArray[np.floating[Any]] | NDArray[np.int64], scores: Scores, count: int, size: tuple[int, int], crowding: float) -> NDArray[np.int64]:
    """Indices of at most `count` of the keypoints (N, 2), highest scores (N,) first, chosen so that they do not crowd.

    The image of `size` (width, height) is divided into about `count` / 4 square cells; first each cell gives its strongest up to `crowding` times its even
    share, then what is missing is filled by score alone. A pose from points on one bright object is badly determined; thermal images have few of them,
    with all the contrast. crowding <= 0 chooses by score alone.
    """
    order = np.argsort(-scores, kind="stable")
    if crowding <= 0 or len(order) <= count:
        return order[:count]
    cell = np.sqrt(4.0 * size[0] * size[1] / count)
    columns, rows = int(np.ceil(size[0] / cell)), int(np.ceil(size[1] / cell))
    places = np.floor(keypoints[order] / cell).astype(np.int64)
    cells = np.clip(places[:, 1], 0, rows - 1) * columns + np.clip(places[:, 0], 0, columns - 1)
    by_cell = np.argsort(cells, kind="stable")  # within a cell still strongest first
    starts = np.flatnonzero(np.diff(cells[by_cell], prepend=-1))
    rank = np.empty(len(order), np.int64)
    rank[by_cell] = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    within = rank < max(1, round(crowding * count / (columns * rows)))
    first = np.flatnonzero(within)[:count]
    rest = np.flatnonzero(~within)[: count - len(first)]
    return order[np.sort(np.concatenate((first, rest)))]
