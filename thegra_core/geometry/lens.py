"""The pinhole camera's lens, compiled: every frame's keypoints go through its inverse."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
_MAX_ITERATIONS = 100
_CONVERGED = 1e-12
_LONGEST_STEP = 0.3
"""On the plane z = 1: a damped step keeps strongly distorted corners from jumping over the radius where the model turns back."""


@numba.njit(cache=True, error_model="numpy")
def _bend(d: FloatArray, x: float, y: float) -> tuple[float, float, float, float, float]:
    """Distorted coordinates of one point, and the entries xx, xy = yx and yy of their derivative by the undistorted."""
    x2, y2, xy = x * x, y * y, x * y
    r2 = x2 + y2
    radial = 1 + r2 * (d[0] + r2 * (d[1] + r2 * d[4]))
    slope = d[0] + r2 * (2 * d[1] + r2 * 3 * d[4])  # by r2
    below = 1 + r2 * (d[5] + r2 * (d[6] + r2 * d[7]))
    radial = radial / below
    slope = (slope - radial * (d[5] + r2 * (2 * d[6] + r2 * 3 * d[7]))) / below
    bent_x, bent_y = x * radial + 2 * d[2] * xy + d[3] * (r2 + 2 * x2), y * radial + d[2] * (r2 + 2 * y2) + 2 * d[3] * xy
    across = 2 * (slope * xy + d[2] * x + d[3] * y)
    return bent_x, bent_y, radial + 2 * slope * x2 + 2 * d[2] * y + 6 * d[3] * x, across, radial + 2 * slope * y2 + 6 * d[2] * y + 2 * d[3] * x


@numba.njit("float64[:, ::1](float64[::1], float64[:, ::1])", cache=True, error_model="numpy")
def distort(coefficients: FloatArray, normalized: FloatArray) -> FloatArray:
    """Distorted coordinates (N, 2) of undistorted ones (N, 2); coefficients (8,) k1 k2 p1 p2 k3 k4 k5 k6, the last three 0 without a denominator."""
    bent = np.empty_like(normalized)
    for n in range(len(normalized)):
        bent[n, 0], bent[n, 1], _, _, _ = _bend(coefficients, normalized[n, 0], normalized[n, 1])
    return bent


@numba.njit("float64[:, ::1](float64[::1], float64[:, ::1])", cache=True, error_model="numpy")
def undistort(coefficients: FloatArray, distorted: FloatArray) -> FloatArray:
    """Undistorted coordinates (N, 2) of distorted ones (N, 2), by Newton's method on `distort` until all have converged; NaN for those that do not."""
    found = distorted.copy()
    for _ in range(_MAX_ITERATIONS):
        longest = 0.0
        for n in range(len(distorted)):
            bent_x, bent_y, xx, xy, yy = _bend(coefficients, found[n, 0], found[n, 1])
            off_x, off_y = bent_x - distorted[n, 0], bent_y - distorted[n, 1]
            determinant = xx * yy - xy * xy
            step_x, step_y = (yy * off_x - xy * off_y) / determinant, (xx * off_y - xy * off_x) / determinant
            length = np.sqrt(step_x * step_x + step_y * step_y)
            if length > _LONGEST_STEP:
                step_x, step_y = step_x * (_LONGEST_STEP / length), step_y * (_LONGEST_STEP / length)
            found[n, 0] -= step_x
            found[n, 1] -= step_y
            longest = max(longest, abs(step_x), abs(step_y)) if length == length else longest
        if longest < _CONVERGED:
            break
    for n in range(len(distorted)):
        bent_x, bent_y, _, _, _ = _bend(coefficients, found[n, 0], found[n, 1])
        off_x, off_y = bent_x - distorted[n, 0], bent_y - distorted[n, 1]
        if not np.sqrt(off_x * off_x + off_y * off_y) < 1e-9:
            found[n] = np.nan
    return found
