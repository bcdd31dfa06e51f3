"""Repair of what a thermal sensor adds of its own: stripes of its columns and rows, dead pixels. Pure functions; the type stays."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from thegra_core.messages import ImageArray

Float32Array = NDArray[np.float32]
_MAD_TO_SIGMA = 1.4826
_TINY = 1e-30


def destripe(image: ImageArray, columns: bool = True, rows: bool = False, width: int = 21) -> ImageArray:
    """Take off the offset that the read-out gives each column and row.

    The offset's step from one column to the next is the median over the rows of the pixels' differences, to which edges of the scene contribute little.
    Of the steps' sum only what differs from its surroundings is taken off: what changes slowly along the image is the scene's.

    Args:
        image: Any of the three types.
        columns: Repair columns (vertical stripes).
        rows: Repair rows (horizontal stripes).
        width: px, odd, of the parabolas fitted to tell slow from fast.
    """
    values = image.astype(np.float32)
    if columns:
        values = values - _offsets(values, width)[None, :]
    if rows:
        values = values - _offsets(values.T, width)[:, None]
    return _as_type_of(values, image)


def svd_destripe(image: ImageArray, components: int = 1, width: int = 15) -> ImageArray:
    """Take off vertical stripes whose strength changes from row to row: the strongest singular components of the steps between columns.

    Stripes are one row repeated with a gain of each row's own, a matrix of rank one; what changes slowly along the rows, and the part of a step beyond
    its row's usual one (an edge), is left to the scene.

    Args:
        image: Any of the three types, at least 5 px wide; narrower ones are given back.
        components: Singular components taken for stripes.
        width: px, odd, of the parabolas fitted to tell slow from fast.
    """
    values = image.astype(np.float32)
    window = _odd(min(width, values.shape[1] - 1))
    if window < 3:
        return image.copy()
    steps = np.diff(values, axis=1)
    usual = _MAD_TO_SIGMA * np.median(np.abs(steps), axis=1, keepdims=True)
    steps = _fast_part(np.clip(steps, -usual, usual), window)
    _, vectors = np.linalg.eigh((steps.T @ steps).astype(np.float64))
    basis = vectors[:, -components:]
    profiles = _fast_part(np.pad(np.cumsum(basis, axis=0), ((1, 0), (0, 0))).T, window)
    return _as_type_of(np.asarray(values - (steps @ basis) @ profiles, np.float32), image)


def repair_dead_pixels(image: ImageArray, threshold: float = 8.0) -> ImageArray:
    """Replace single pixels that differ from all their neighbours by the neighbours' median.

    Args:
        image: Any of the three types.
        threshold: Times the image's usual difference between neighbours (a robust standard deviation) that a pixel must lie above the largest or
            below the smallest of its eight neighbours.
    """
    values = image.astype(np.float32)
    steps = np.abs(np.diff(values, axis=1))
    usual = float(_MAD_TO_SIGMA * np.median(steps)) if steps.size else 0.0
    ring = np.ones((3, 3), np.uint8)
    ring[1, 1] = 0
    above, below = values - cv2.dilate(values, ring), cv2.erode(values, ring) - values
    dead = np.maximum(above, below) > threshold * max(usual, _TINY)
    if not dead.any():
        return image.copy()
    result = image.copy()
    y, x = np.nonzero(dead)
    padded = np.pad(values, 1, mode="reflect" if min(values.shape) > 1 else "edge")
    around = np.stack([padded[y + dy, x + dx] for dy in range(3) for dx in range(3) if (dy, dx) != (1, 1)])
    result[dead] = _as_type_of(np.asarray(np.median(around, axis=0), np.float32), image)
    return result


def _offsets(values: Float32Array, width: int) -> Float32Array:
    """(W,) offset of each column of (H, W) values, without what changes slowly."""
    window = _odd(min(width, values.shape[1]))
    if window < 3:
        return np.zeros(values.shape[1], np.float32)
    profile = np.concatenate(([0.0], np.cumsum(np.median(np.diff(values, axis=1), axis=0))))
    return np.asarray(_fast_part(profile, window), np.float32)


def _fast_part(values: NDArray[Any], window: int) -> NDArray[Any]:
    """Values (..., N) less the parabolas that fit them best over `window` neighbours (Savitzky and Golay 1964)."""
    return np.asarray(values - savgol_filter(values, window, min(2, window - 1), axis=-1))


def _odd(count: int) -> int:
    return count - (count + 1) % 2


def _as_type_of(values: Float32Array, image: ImageArray) -> ImageArray:
    if image.dtype == np.float32:
        return values
    result: NDArray[Any] = np.clip(np.rint(values), 0, 255 if image.dtype == np.uint8 else 65535).astype(image.dtype)
    return result
