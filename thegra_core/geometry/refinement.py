"""Points moved to where their views agree best, compiled: mapping asks for a few of them many times a keyframe."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
_NEAREST, _DAMPING = 1e-9, 1e-9


def refine_points(
    camera_from_world: FloatArray, normalized: FloatArray, point_index: IntArray, points_world: FloatArray, steps: int = 5
) -> tuple[FloatArray, FloatArray]:
    """Points (P, 3) moved to the least squared reprojection error by Gauss-Newton, and the error (M,) of each observation on the plane z = 1.

    camera_from_world (M, 4, 4) and normalized (M, 2) belong to the M observations, point_index (M,) names the point each sees. A point that a step would
    put behind one of its cameras stays where it is.
    """
    views, pixels, points = (np.ascontiguousarray(values, np.float64) for values in (camera_from_world, normalized, points_world))
    moved: tuple[FloatArray, FloatArray] = _refine(views, pixels, np.ascontiguousarray(point_index, np.int64), points, steps)
    return moved


@numba.njit(cache=True, error_model="numpy")
def _seen(view: FloatArray, point: FloatArray) -> tuple[float, float, float]:
    """A point in the camera frame."""
    x = view[0, 0] * point[0] + view[0, 1] * point[1] + view[0, 2] * point[2] + view[0, 3]
    y = view[1, 0] * point[0] + view[1, 1] * point[1] + view[1, 2] * point[2] + view[1, 3]
    z = view[2, 0] * point[0] + view[2, 1] * point[1] + view[2, 2] * point[2] + view[2, 3]
    return x, y, z


@numba.njit(
    "Tuple((float64[:, ::1], float64[::1]))(float64[:, :, ::1], float64[:, ::1], int64[::1], float64[:, ::1], int64)", cache=True, error_model="numpy"
)
def _refine(views: FloatArray, normalized: FloatArray, point_index: IntArray, start: FloatArray, steps: int) -> tuple[FloatArray, FloatArray]:
    points, moved = start.copy(), start.copy()
    normal, right, slope = np.empty((len(start), 3, 3)), np.empty((len(start), 3)), np.empty((2, 3))
    behind = np.empty(len(start), np.bool_)
    for _ in range(steps):
        normal[:], right[:], behind[:] = 0.0, 0.0, False
        for m in range(len(point_index)):
            i, view = point_index[m], views[m]
            x, y, z = _seen(view, points[i])
            if not z > _NEAREST:  # no pull from behind a camera
                continue
            u, v = x / z, y / z
            off_u, off_v = u - normalized[m, 0], v - normalized[m, 1]
            for k in range(3):
                slope[0, k], slope[1, k] = (view[0, k] - u * view[2, k]) / z, (view[1, k] - v * view[2, k]) / z
            for j in range(3):
                right[i, j] += slope[0, j] * off_u + slope[1, j] * off_v
                for k in range(3):
                    normal[i, j, k] += slope[0, j] * slope[0, k] + slope[1, j] * slope[1, k]
        for i in range(len(points)):
            damping = _DAMPING * max(normal[i, 0, 0] + normal[i, 1, 1] + normal[i, 2, 2], 1e-12)
            for k in range(3):
                normal[i, k, k] += damping
            moved[i] = points[i] - np.linalg.solve(normal[i], right[i])
        for m in range(len(point_index)):
            behind[point_index[m]] |= not _seen(views[m], moved[point_index[m]])[2] > _NEAREST
        for i in range(len(points)):
            if not behind[i]:
                points[i] = moved[i]
    errors = np.empty(len(point_index))
    for m in range(len(point_index)):
        x, y, z = _seen(views[m], points[point_index[m]])
        off_u, off_v = x / z - normalized[m, 0], y / z - normalized[m, 1]
        errors[m] = np.sqrt(off_u * off_u + off_v * off_v) if z > 0 else np.inf
    return points, errors
