"""Gauss-Newton over one pose, compiled: forty steps a frame over hundreds of points are most of what tracking computes."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
STEPS = 10
_CONVERGED, _DAMPING, _NEAREST = 1e-8, 1e-9, 1e-9
_compile = numba.njit(cache=True, error_model="numpy")


@_compile
def _normal_equations(
    pose: FloatArray, points_world: FloatArray, normalized: FloatArray, focal: float, weights: FloatArray, huber: float
) -> tuple[FloatArray, FloatArray, int]:
    normal, gradient = np.zeros((6, 6)), np.zeros(6)
    along_u, along_v = np.zeros(6), np.zeros(6)
    count = 0
    for n in range(len(points_world)):
        p = points_world[n]
        x = pose[0, 0] * p[0] + pose[0, 1] * p[1] + pose[0, 2] * p[2] + pose[0, 3]
        y = pose[1, 0] * p[0] + pose[1, 1] * p[1] + pose[1, 2] * p[2] + pose[1, 3]
        z = pose[2, 0] * p[0] + pose[2, 1] * p[1] + pose[2, 2] * p[2] + pose[2, 3]
        if not z > _NEAREST:
            continue
        count += 1
        inverse_z = 1.0 / z
        u, v = x * inverse_z, y * inverse_z
        residual_u, residual_v = focal * (u - normalized[n, 0]), focal * (v - normalized[n, 1])
        length = np.sqrt(weights[n] * (residual_u * residual_u + residual_v * residual_v))
        weight = weights[n] * min(1.0, huber / max(length, 1e-12))
        along_u[0], along_u[1], along_u[2], along_u[3], along_u[5] = -u * v, 1 + u * u, -v, inverse_z, -u * inverse_z
        along_v[0], along_v[1], along_v[2], along_v[4], along_v[5] = -(1 + v * v), u * v, u, inverse_z, -v * inverse_z
        for i in range(6):
            gradient[i] += weight * focal * (along_u[i] * residual_u + along_v[i] * residual_v)
            for j in range(i + 1):
                normal[i, j] += weight * focal * focal * (along_u[i] * along_u[j] + along_v[i] * along_v[j])
    for i in range(6):
        for j in range(i):
            normal[j, i] = normal[i, j]
    return normal, gradient, count


@_compile
def perturbed(pose: FloatArray, step: FloatArray) -> FloatArray:
    """The pose after a left perturbation (rotation vector, translation); Rodrigues' formula."""
    w = step[:3]
    angle = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    small = angle < 1e-8
    a = 1.0 - angle * angle / 6 if small else np.sin(angle) / angle
    b = 0.5 - angle * angle / 24 if small else (1 - np.cos(angle)) / (angle * angle)
    k = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    rotation = np.eye(3) + a * k + b * (k @ k)
    moved = pose.copy()
    moved[:3, :3] = rotation @ np.ascontiguousarray(pose[:3, :3])
    moved[:3, 3] = rotation @ np.ascontiguousarray(pose[:3, 3]) + step[3:]
    return moved


@numba.njit(
    "Tuple((float64[:, ::1], float64[:, ::1]))(float64[:, ::1], float64[:, ::1], float64[:, ::1], float64, float64[::1], float64)", cache=True, error_model="numpy"
)
def minimize_reprojection(
    camera_from_world: FloatArray, points_world: FloatArray, normalized: FloatArray, focal: float, weights: FloatArray, huber: float
) -> tuple[FloatArray, FloatArray]:
    """At most ten steps towards the least weighted Huber cost of the reprojections of fixed points.

    Args:
        camera_from_world: (4, 4), where it starts.
        points_world: (N, 3); those behind the camera take no part, with less than 3 before it nothing moves.
        normalized: (N, 2) undistorted, finite.
        focal: px.
        weights: (N,) 1/px^2.
        huber: Weighted residual beyond which the cost grows linearly; inf for least squares.

    Returns:
        camera_from_world (4, 4) and the normal matrix (6, 6) of the last step, rotation first, of a left perturbation.
    """
    pose = camera_from_world.copy()
    hessian = np.eye(6)
    for _ in range(STEPS):
        normal, gradient, count = _normal_equations(pose, points_world, normalized, focal, weights, huber)
        if count < 3:
            break
        hessian = normal
        step = -np.linalg.solve(hessian + _DAMPING * np.trace(hessian) * np.eye(6), gradient)
        pose = perturbed(pose, step)
        if np.abs(step).max() < _CONVERGED:
            break
    return pose, hessian
