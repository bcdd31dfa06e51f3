"""Points that an adjustment is better made without: their views do not tell where they are, or one of these is so near that no step is short enough for it."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MOST_ELONGATED = 1e7
"""Largest over least information of a point in any direction beyond which it is not told: rays less than 0.02 degrees apart. One such point makes gtsam's
linear systems indeterminate."""
NEAREST_SHARE = 0.01
"""Of the median depth of all observations, the least depth of a point. One in a camera's centre lets Levenberg and Marquardt's steps become so short that nothing else moves."""
_DOUBTFUL = 1e-6
"""Determinant over cubed trace of the information below which the ratio is looked at: above it, it is less than a tenth of `MOST_ELONGATED`."""
_NEAREST = 1e-12
_compile = numba.njit(cache=True, error_model="numpy")


def undetermined(camera_from_world: FloatArray, points_world: FloatArray, keyframe_index: IntArray, point_index: IntArray) -> BoolArray:
    """(P,) which points (P, 3) M observations do not tell: of rows `keyframe_index` (M,) of the poses (K, 4, 4) and `point_index` (M,); those without any included."""
    information, depth = _seen(
        np.ascontiguousarray(camera_from_world), np.ascontiguousarray(points_world), np.ascontiguousarray(keyframe_index), np.ascontiguousarray(point_index)
    )
    if len(depth) == 0:
        return np.ones(len(points_world), bool)
    trace = np.trace(information, axis1=1, axis2=2)
    result = ~(np.linalg.det(information) > _DOUBTFUL * trace**3)
    doubtful = np.flatnonzero(result & (trace > 0))
    least, _, most = np.linalg.eigvalsh(information[doubtful]).T
    result[doubtful] = most > MOST_ELONGATED * np.maximum(least, 0.0)
    result[point_index[depth < NEAREST_SHARE * np.median(depth)]] = True
    return np.asarray(result)


@_compile
def _seen(camera_from_world: FloatArray, points_world: FloatArray, keyframe_index: IntArray, point_index: IntArray) -> tuple[FloatArray, FloatArray]:
    """Information (P, 3, 3) of all observations, of unit weight in normalized coordinates, and the depth (M,) of each, on whichever side of the camera."""
    information, slopes, depth = np.zeros((len(points_world), 3, 3)), np.empty((2, 3)), np.empty(len(point_index))
    for m in range(len(point_index)):
        pose, p = camera_from_world[keyframe_index[m]], points_world[point_index[m]]
        z = pose[2, 0] * p[0] + pose[2, 1] * p[1] + pose[2, 2] * p[2] + pose[2, 3]
        if abs(z) < _NEAREST:
            z = _NEAREST
        depth[m] = abs(z)
        for a in range(2):
            seen = (pose[a, 0] * p[0] + pose[a, 1] * p[1] + pose[a, 2] * p[2] + pose[a, 3]) / z
            for c in range(3):
                slopes[a, c] = (pose[a, c] - seen * pose[2, c]) / z
        for a in range(3):
            for c in range(3):
                information[point_index[m], a, c] += slopes[0, a] * slopes[0, c] + slopes[1, a] * slopes[1, c]
    return information, depth
