"""Levenberg-Marquardt over keyframes and points, compiled, points eliminated first (Schur complement; Triggs et al. 1999, sec. 6).

The reduced system of the keyframes is dense: it is for the tens of keyframes of a local adjustment, which it solves in a fraction of the time that a general
factor graph takes to be built and solved.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numba
import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry import poses
from thegra_core.optimization.gauss_newton import perturbed

if TYPE_CHECKING:
    from thegra_core.optimization.bundle import BundleProblem

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING, _FACTOR, _NEAREST, _TINY = 1e-4, 1e-10, 1e8, 10.0, 1e-9, 1e-12
_compile = numba.njit(cache=True, error_model="numpy")


@_compile
def _robust(squared: float, huber: float) -> float:
    """Huber's cost of a squared weighted residual."""
    return 0.5 * squared if squared <= huber * huber else huber * (np.sqrt(squared) - 0.5 * huber)


@_compile
def _cost(
    camera: FloatArray, points: FloatArray, starts: IntArray, observer: IntArray, normalized: FloatArray, focal: float, weights: FloatArray, huber: float
) -> float:
    """Of all observations; one behind its camera costs what two focal lengths would."""
    total = 0.0
    for i in range(len(points)):
        for m in range(starts[i], starts[i + 1]):
            pose, p = camera[observer[m]], points[i]
            z = pose[2, 0] * p[0] + pose[2, 1] * p[1] + pose[2, 2] * p[2] + pose[2, 3]
            squared = 4.0 * focal * focal
            if z > _NEAREST:
                u = (pose[0, 0] * p[0] + pose[0, 1] * p[1] + pose[0, 2] * p[2] + pose[0, 3]) / z - normalized[m, 0]
                v = (pose[1, 0] * p[0] + pose[1, 1] * p[1] + pose[1, 2] * p[2] + pose[1, 3]) / z - normalized[m, 1]
                squared = focal * focal * (u * u + v * v)
            total += _robust(weights[m] * squared, huber)
    return total


@_compile
def _linearize(
    camera: FloatArray, free: IntArray, points: FloatArray, starts: IntArray, observer: IntArray, normalized: FloatArray, focal: float, weights: FloatArray, huber: float,
    of_cameras: FloatArray, of_points: FloatArray, between: FloatArray, to_cameras: FloatArray, to_points: FloatArray,
) -> None:  # fmt: skip
    """Blocks of the normal equations: cameras (F, 6, 6), points (P, 3, 3), an observation's (M, 6, 3) between both, gradients (F, 6) and (P, 3)."""
    of_cameras[:], of_points[:], between[:], to_cameras[:], to_points[:] = 0.0, 0.0, 0.0, 0.0, 0.0
    along, across = np.zeros((2, 6)), np.zeros((2, 3))
    for i in range(len(points)):
        p = points[i]
        for m in range(starts[i], starts[i + 1]):
            pose, k = camera[observer[m]], free[observer[m]]
            z = pose[2, 0] * p[0] + pose[2, 1] * p[1] + pose[2, 2] * p[2] + pose[2, 3]
            if not z > _NEAREST:
                continue
            inverse_z = 1.0 / z
            u = (pose[0, 0] * p[0] + pose[0, 1] * p[1] + pose[0, 2] * p[2] + pose[0, 3]) * inverse_z
            v = (pose[1, 0] * p[0] + pose[1, 1] * p[1] + pose[1, 2] * p[2] + pose[1, 3]) * inverse_z
            residual_u, residual_v = focal * (u - normalized[m, 0]), focal * (v - normalized[m, 1])
            length = np.sqrt(weights[m] * (residual_u * residual_u + residual_v * residual_v))
            weight = weights[m] * min(1.0, huber / max(length, _TINY))
            for c in range(3):
                across[0, c] = focal * inverse_z * (pose[0, c] - u * pose[2, c])
                across[1, c] = focal * inverse_z * (pose[1, c] - v * pose[2, c])
            for a in range(3):
                to_points[i, a] += weight * (across[0, a] * residual_u + across[1, a] * residual_v)
                for b in range(3):
                    of_points[i, a, b] += weight * (across[0, a] * across[0, b] + across[1, a] * across[1, b])
            if k < 0:
                continue
            along[0, 0], along[0, 1], along[0, 2] = -focal * u * v, focal * (1 + u * u), -focal * v
            along[0, 3], along[0, 4], along[0, 5] = focal * inverse_z, 0.0, -focal * u * inverse_z
            along[1, 0], along[1, 1], along[1, 2] = -focal * (1 + v * v), focal * u * v, focal * u
            along[1, 3], along[1, 4], along[1, 5] = 0.0, focal * inverse_z, -focal * v * inverse_z
            for a in range(6):
                to_cameras[k, a] += weight * (along[0, a] * residual_u + along[1, a] * residual_v)
                for b in range(6):
                    of_cameras[k, a, b] += weight * (along[0, a] * along[0, b] + along[1, a] * along[1, b])
                for b in range(3):
                    between[m, a, b] = weight * (along[0, a] * across[0, b] + along[1, a] * across[1, b])


@_compile
def _inverse(block: FloatArray, damping: float) -> FloatArray:
    """Of a damped symmetric (3, 3) block."""
    least = _TINY * (block[0, 0] + block[1, 1] + block[2, 2]) + 1e-300
    a, d, f = (1 + damping) * block[0, 0] + least, (1 + damping) * block[1, 1] + least, (1 + damping) * block[2, 2] + least
    b, c, e = block[0, 1], block[0, 2], block[1, 2]
    x, y, z = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * x + b * y + c * z)
    inverse = np.empty((3, 3))
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = scale * x, scale * (a * f - c * c), scale * (a * d - b * b)
    inverse[0, 1] = inverse[1, 0] = scale * y
    inverse[0, 2] = inverse[2, 0] = scale * z
    inverse[1, 2] = inverse[2, 1] = scale * (b * c - a * e)
    return inverse


@_compile
def _step(
    free: IntArray, starts: IntArray, observer: IntArray, of_cameras: FloatArray, of_points: FloatArray, between: FloatArray, to_cameras: FloatArray,
    to_points: FloatArray, damping: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Steps of cameras (F, 6) and points (P, 3) that solve the damped normal equations."""
    count, most = len(of_cameras), 0
    for i in range(len(of_points)):
        most = max(most, starts[i + 1] - starts[i])
    reduced, right = np.zeros((6 * count, 6 * count)), np.zeros(6 * count)
    for k in range(count):
        for a in range(6):
            right[6 * k + a] = -to_cameras[k, a]
            for b in range(6):
                reduced[6 * k + a, 6 * k + b] = of_cameras[k, a, b]
            reduced[6 * k + a, 6 * k + a] += damping * of_cameras[k, a, a] + _TINY
    inverses = np.empty_like(of_points)
    scaled = np.empty((most, 6, 3))
    for i in range(len(of_points)):
        inverses[i] = _inverse(of_points[i], damping)
        for m in range(starts[i], starts[i + 1]):
            k = free[observer[m]]
            if k < 0:
                continue
            mine = scaled[m - starts[i]]
            for a in range(6):
                for b in range(3):
                    mine[a, b] = between[m, a, 0] * inverses[i, 0, b] + between[m, a, 1] * inverses[i, 1, b] + between[m, a, 2] * inverses[i, 2, b]
                right[6 * k + a] += mine[a, 0] * to_points[i, 0] + mine[a, 1] * to_points[i, 1] + mine[a, 2] * to_points[i, 2]
            for n in range(starts[i], m + 1):
                other = free[observer[n]]
                if other < 0:
                    continue
                for a in range(6):
                    for b in range(6):
                        shared = mine[a, 0] * between[n, b, 0] + mine[a, 1] * between[n, b, 1] + mine[a, 2] * between[n, b, 2]
                        reduced[6 * k + a, 6 * other + b] -= shared
                        if n != m:
                            reduced[6 * other + b, 6 * k + a] -= shared
    cameras = np.empty((count, 6))
    cameras[:] = np.linalg.solve(reduced, right).reshape((count, 6))
    points = np.empty((len(of_points), 3))
    gradient = np.empty(3)
    for i in range(len(of_points)):
        gradient[:] = to_points[i]
        for m in range(starts[i], starts[i + 1]):
            k = free[observer[m]]
            if k >= 0:
                for b in range(3):
                    for a in range(6):
                        gradient[b] += between[m, a, b] * cameras[k, a]
        for b in range(3):
            points[i, b] = -(inverses[i, b, 0] * gradient[0] + inverses[i, b, 1] * gradient[1] + inverses[i, b, 2] * gradient[2])
    return cameras, points


@numba.njit(
    "Tuple((float64[:, :, ::1], float64[:, ::1]))(float64[:, :, ::1], int64[::1], float64[:, ::1], int64[::1], int64[::1], float64[:, ::1], float64, float64[::1],"
    " float64, int64, float64)",
    cache=True, error_model="numpy",
)  # fmt: skip
def minimize_bundle(
    camera_from_world: FloatArray, free: IntArray, points_world: FloatArray, starts: IntArray, observer: IntArray, normalized: FloatArray, focal: float,
    weights: FloatArray, huber: float, iterations: int, tolerance: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Poses (K, 4, 4) and points (P, 3) of least weighted Huber cost from where they start, after at most `iterations` linearisations.

    It ends, too, where a step lessens the cost by less than its share `tolerance`, or no step does.

    Args:
        camera_from_world: (K, 4, 4).
        free: (K,) 0 to F - 1 of the poses that move, -1 of those that do not.
        points_world: (P, 3).
        starts: (P + 1,) where in the observations those of each point begin.
        observer: (M,) row of the pose, points in order.
        normalized: (M, 2) undistorted, finite.
        focal: px.
        weights: (M,) 1/px^2.
        huber: Weighted residual beyond which the cost grows linearly.
    """
    camera, points = camera_from_world.copy(), points_world.copy()
    count = free.max() + 1
    of_cameras, to_cameras = np.empty((count, 6, 6)), np.empty((count, 6))
    of_points, to_points, between = np.empty((len(points), 3, 3)), np.empty((len(points), 3)), np.empty((len(observer), 6, 3))
    cost, damping = _cost(camera, points, starts, observer, normalized, focal, weights, huber), _FIRST_DAMPING
    for _ in range(iterations):
        _linearize(
            camera, free, points, starts, observer, normalized, focal, weights, huber, of_cameras, of_points, between, to_cameras, to_points
        )
        before = cost
        while damping <= _MOST_DAMPING:
            step, shift = _step(free, starts, observer, of_cameras, of_points, between, to_cameras, to_points, damping)
            moved, shifted = camera.copy(), points + shift
            for k in range(len(camera)):
                if free[k] >= 0:
                    moved[k] = perturbed(camera[k], step[free[k]])
            reached = _cost(moved, shifted, starts, observer, normalized, focal, weights, huber)
            if reached < cost:
                camera, points, cost, damping = moved, shifted, reached, max(damping / _FACTOR, _LEAST_DAMPING)
                break
            damping *= _FACTOR
        if before - cost <= tolerance * before:
            break
    return camera, points


class SchurSystem:
    """`Minimizer` of a problem."""

    def __init__(self, problem: BundleProblem, huber_px: float) -> None:
        self._problem = problem
        self._huber = huber_px
        self._by_point = np.argsort(problem.point_index, kind="stable")

    def minimize(
        self, world_from_camera: FloatArray, points_world: FloatArray, used: BoolArray, keyframe_rows: IntArray, point_rows: IntArray,
        scale_from: tuple[int, int] | None, iterations: int, tolerance: float,
    ) -> tuple[FloatArray, FloatArray] | None:  # fmt: skip
        """See `Minimizer.minimize`. A free scale needs no factor: damped steps leave alone what nothing speaks about."""
        problem = self._problem
        rows = self._by_point[used[self._by_point]]
        starts = np.append(np.searchsorted(problem.point_index[rows], point_rows), len(rows)).astype(np.int64)
        moving = keyframe_rows[~problem.fixed[keyframe_rows]]
        free = np.full(len(world_from_camera), -1, np.int64)
        free[moving] = np.arange(len(moving))
        camera_from_world = np.stack([poses.inverse(pose) for pose in world_from_camera])
        try:
            found, points = minimize_bundle(
                camera_from_world, free, np.ascontiguousarray(points_world[point_rows]), starts, np.ascontiguousarray(problem.keyframe_index[rows], np.int64),
                np.ascontiguousarray(problem.normalized[rows]), float(problem.focal), np.ascontiguousarray(problem.weights[rows]), float(self._huber),
                iterations, float(tolerance),
            )  # fmt: skip
        except np.linalg.LinAlgError:
            return None
        camera, moved = world_from_camera.copy(), points_world.copy()
        camera[moving] = np.stack([poses.inverse(pose) for pose in found[moving]])
        moved[point_rows] = points
        return camera, moved
