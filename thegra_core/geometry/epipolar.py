"""Two-view geometry on undistorted coordinates of the plane z = 1.

`camera1_from_camera0` is the motion; x1^T E x0 = 0 with E = [t]x R.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry import poses
from thegra_core.geometry.alignment import align_bearings

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def homogeneous(normalized: FloatArray) -> FloatArray:
    """(N, 3) with a last coordinate of 1 of (N, 2)."""
    return np.concatenate([normalized, np.ones((len(normalized), 1))], axis=1)


def essential(camera1_from_camera0: FloatArray) -> FloatArray:
    """Essential matrices (..., 3, 3) of relative poses (..., 4, 4), translation scaled to length 1."""
    t = camera1_from_camera0[..., :3, 3]
    return np.asarray(poses.skew(t / np.linalg.norm(t, axis=-1, keepdims=True)) @ camera1_from_camera0[..., :3, :3])


def sampson_errors(essential_matrix: FloatArray, normalized0: FloatArray, normalized1: FloatArray) -> FloatArray:
    """First-order distances (N,) to the epipolar constraint, on the plane z = 1 (Hartley and Zisserman 2004, Eq. 11.9)."""
    return np.abs(signed_sampson_errors(essential_matrix, normalized0, normalized1))


def signed_sampson_errors(essential_matrix: FloatArray, normalized0: FloatArray, normalized1: FloatArray) -> FloatArray:
    """`sampson_errors` with the sign of the algebraic error: smooth through zero, for least squares."""
    x0, x1 = homogeneous(normalized0), homogeneous(normalized1)
    line1, line0 = x0 @ essential_matrix.T, x1 @ essential_matrix
    algebraic = np.einsum("ni,ni->n", x1, line1)
    scale = np.sqrt((line1[:, :2] ** 2).sum(axis=1) + (line0[:, :2] ** 2).sum(axis=1))
    return np.asarray(algebraic / np.maximum(scale, 1e-15))


def epipolar_distances(camera1_from_camera0: FloatArray, normalized0: FloatArray, normalized1: FloatArray) -> FloatArray:
    """Distances (N,) of the second points to the epipolar lines of the first, on the plane z = 1."""
    lines = homogeneous(normalized0) @ essential(camera1_from_camera0).T
    return np.asarray(np.abs(np.einsum("ni,ni->n", homogeneous(normalized1), lines)) / np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-15))


def homography_errors(homography: FloatArray, normalized0: FloatArray, normalized1: FloatArray) -> FloatArray:
    """Distances (N,) in the second view between points and those mapped by a homography (3, 3)."""
    mapped = homogeneous(normalized0) @ homography.T
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - normalized1, axis=1)
    return np.where(mapped[:, 2] > 0, error, np.inf)


def fit_rotation(normalized0: FloatArray, normalized1: FloatArray, scale: float, iterations: int = 20) -> tuple[FloatArray, FloatArray]:
    """The pure rotation (3, 3) that explains two views best, and the distances (N,) on the plane z = 1 that it leaves.

    Least squares reweighted by the Geman-McClure function of the distance over `scale`, started from the median flow, so that
    near points with parallax or moving things do not pull it.
    """
    rays0, rays1 = homogeneous(normalized0), homogeneous(normalized1)
    rays0 /= np.linalg.norm(rays0, axis=1, keepdims=True)
    rays1 /= np.linalg.norm(rays1, axis=1, keepdims=True)
    rotation = align_bearings(rays0, rays1)
    spread = max(scale, float(np.median(homography_errors(rotation, normalized0, normalized1))))
    for _ in range(iterations):
        error = homography_errors(rotation, normalized0, normalized1)
        weights = 1.0 / (1.0 + np.minimum(error / spread, 1e6) ** 2) ** 2
        rotation = align_bearings(rays0, rays1, weights)
        spread = max(scale, spread * 0.7)
    return rotation, homography_errors(rotation, normalized0, normalized1)


def refine_relative_pose(
    camera1_from_camera0: FloatArray, normalized0: FloatArray, normalized1: FloatArray, scale: float, rng: np.random.Generator, hypotheses: int = 128
) -> FloatArray:
    """Iterative minimal-set refinement of an essential matrix (Rosten, Reitmayr and Drummond 2010, "Improved RANSAC performance using
    simple, iterative minimal-set solvers"; paper Sec. III-C).

    Five points at a time, Gauss-Newton on the five parameters (rotation; direction of translation) from the given pose, for `hypotheses` random
    sets at once; the set with the least truncated Sampson cost wins, then Levenberg-Marquardt on its inliers.
    scale: standard deviation of a coordinate on the plane z = 1. Returns the pose with a unit translation.
    """
    start = camera1_from_camera0.copy()
    start[:3, 3] /= np.linalg.norm(start[:3, 3])
    gate = (2.0 * scale) ** 2

    def cost(candidate: FloatArray) -> float:
        return float(np.minimum(sampson_errors(essential(candidate), normalized0, normalized1) ** 2, gate).sum())

    best, best_cost = start, cost(start)
    if len(normalized0) >= 8:
        samples = np.stack([rng.choice(len(normalized0), 5, replace=False) for _ in range(hypotheses)])
        for candidate in _minimal_sets(start, homogeneous(normalized0)[samples], homogeneous(normalized1)[samples]):
            candidate_cost = cost(candidate)
            if candidate_cost < best_cost:
                best, best_cost = candidate, candidate_cost
    return _levenberg_marquardt(best, normalized0, normalized1, scale)


def _translation_basis(direction: FloatArray) -> FloatArray:
    """Two unit vectors (..., 3, 2) orthogonal to unit directions (..., 3)."""
    axis = np.zeros_like(direction)
    np.put_along_axis(axis, np.argmin(np.abs(direction), axis=-1)[..., None], 1.0, axis=-1)
    first = np.cross(direction, axis)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(direction, first)], axis=-1)


def _residuals_and_jacobian(rotation: FloatArray, t: FloatArray, x0: FloatArray, x1: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Algebraic residuals x1^T [t]x R x0 (..., M) and derivatives (..., M, 5) by a left rotation increment and a tangent of t."""
    moved = np.einsum("...ij,...mj->...mi", rotation, x0)
    crossed = np.cross(t[..., None, :], moved)
    residual = np.einsum("...mi,...mi->...m", x1, crossed)
    # x1 . (t x (w x m)) = w . (m x (x1 x t)); x1 . (dt x m) = dt . (m x x1)
    by_rotation = np.cross(moved, np.cross(x1, t[..., None, :]))
    by_translation = np.cross(moved, x1) @ _translation_basis(t)
    return residual, np.concatenate([by_rotation, by_translation], axis=-1)


def _step(rotation: FloatArray, t: FloatArray, delta: FloatArray) -> tuple[FloatArray, FloatArray]:
    moved = t + np.einsum("...ij,...j->...i", _translation_basis(t), delta[..., 3:])
    return poses.so3_exp(delta[..., :3]) @ rotation, moved / np.linalg.norm(moved, axis=-1, keepdims=True)


def _minimal_sets(start: FloatArray, x0: FloatArray, x1: FloatArray, steps: int = 10) -> list[FloatArray]:
    """Converged poses among `len(x0)` five-point sets (S, 5, 3), each by at most `steps` Gauss-Newton steps."""
    count = len(x0)
    rotation, t = np.broadcast_to(start[:3, :3], (count, 3, 3)), np.broadcast_to(start[:3, 3], (count, 3))
    for _ in range(steps):
        residual, jacobian = _residuals_and_jacobian(rotation, t, x0, x1)
        damped = jacobian + 1e-12 * np.eye(5)
        singular = np.abs(np.linalg.det(damped)) < 1e-30
        damped[singular] = np.eye(5)
        delta = np.linalg.solve(damped, -residual[..., None])[..., 0]
        delta[singular] = 0.0
        length = np.linalg.norm(delta, axis=1, keepdims=True)
        limited: FloatArray = np.where(length > 0.3, delta * (0.3 / np.maximum(length, 1e-12)), delta)
        rotation, t = _step(rotation, t, limited)
    residual, _ = _residuals_and_jacobian(rotation, t, x0, x1)
    converged = np.linalg.norm(residual, axis=1) < 1e-6
    return [poses.transform(r, direction) for r, direction in zip(rotation[converged], t[converged], strict=True)]


def _levenberg_marquardt(start: FloatArray, normalized0: FloatArray, normalized1: FloatArray, scale: float, iterations: int = 30) -> FloatArray:
    """Least Geman-McClure Sampson cost from `start`."""
    x0, x1 = homogeneous(normalized0), homogeneous(normalized1)

    def weigh(pose: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        e = essential(pose)
        line1, line0 = x0 @ e.T, x1 @ e
        inverse_norm2 = 1.0 / np.maximum((line1[:, :2] ** 2).sum(axis=1) + (line0[:, :2] ** 2).sum(axis=1), 1e-15)
        squared = np.einsum("ni,ni->n", x1, line1) ** 2 * inverse_norm2 / scale**2
        return inverse_norm2 / (1.0 + squared / 4) ** 2, squared, float((squared / (1.0 + squared / 4)).sum())

    pose, damping = start, 1e-3
    weights, _, cost = weigh(pose)
    for _ in range(iterations):
        residual, jacobian = _residuals_and_jacobian(pose[:3, :3], pose[:3, 3], x0, x1)
        hessian = (jacobian * weights[:, None]).T @ jacobian
        gradient = (jacobian * weights[:, None]).T @ residual
        delta = np.asarray(np.linalg.solve(hessian + damping * np.diag(np.diag(hessian) + 1e-12), -gradient), dtype=np.float64)
        candidate = poses.transform(*_step(pose[:3, :3], pose[:3, 3], delta))
        new_weights, _, new_cost = weigh(candidate)
        if new_cost < cost:
            converged = cost - new_cost < 1e-9 * cost
            pose, weights, cost, damping = candidate, new_weights, new_cost, damping / 3
            if converged:
                break
        else:
            damping *= 5
            if damping > 1e6:
                break
    return pose
