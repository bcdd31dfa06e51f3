"""Least-squares alignment of point sets and of directions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def umeyama(source: FloatArray, target: FloatArray, with_scale: bool = True) -> tuple[float, FloatArray, FloatArray]:
    """Similarity (scale, R (3, 3), t (3,)) with target ~ scale R source + t, points (N, 3), N >= 1 (Umeyama 1991, Eq. 39-42)."""
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    centred = source - mean_source
    covariance = (target - mean_target).T @ centred / len(source)
    u, d, vt = np.linalg.svd(covariance)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ np.diag(sign) @ vt
    variance = float((centred**2).sum() / len(source))
    scale = float((d * sign).sum() / variance) if with_scale and variance > 0 else 1.0
    return scale, rotation, mean_target - scale * rotation @ mean_source


def align_bearings(source: FloatArray, target: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Rotation (3, 3) with target ~ R source for unit vectors (N, 3), weighted least squares (Kabsch 1976)."""
    w = np.ones(len(source)) if weights is None else weights
    u, _, vt = np.linalg.svd((target * w[:, None]).T @ source)
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt)
