"""Points from posed views, and the quantities that say whether to believe them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry import poses

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def triangulate(camera0_from_world: FloatArray, camera1_from_world: FloatArray, normalized0: FloatArray, normalized1: FloatArray) -> FloatArray:
    """points_world (N, 3) of undistorted coordinates (N, 2) in two views.

    Linear least squares on the inhomogeneous equations (Hartley and Zisserman 2004, Sec. 12.2), which keeps its accuracy at the small
    angles of a new map; NaN where the rays are parallel.
    """
    return triangulate_views(np.stack([camera0_from_world, camera1_from_world]), np.stack([normalized0, normalized1], axis=1))


def triangulate_views(camera_from_world: FloatArray, normalized: FloatArray) -> FloatArray:
    """points_world (N, 3) seen in V views: transforms (V, 4, 4), undistorted coordinates (N, V, 2), NaN where a view has no observation."""
    seen = np.asarray(np.isfinite(normalized).all(axis=2))
    xy = np.where(seen[..., None], normalized, 0.0)
    p = camera_from_world[None, :, :3, :]
    rows = xy[..., None] * p[:, :, 2:3, :] - p[:, :, :2, :]
    rows = np.where(seen[..., None, None], rows, 0.0).reshape(len(normalized), 2 * len(camera_from_world), 4)
    a, b = rows[..., :3], -rows[..., 3]
    normal = np.einsum("nri,nrj->nij", a, a)
    right = np.einsum("nri,nr->ni", a, b)
    good = np.asarray(np.linalg.cond(normal)) < 1e14
    points = np.full((len(normalized), 3), np.nan)
    points[good] = np.linalg.solve(normal[good], right[good][..., None])[..., 0]
    return points


def refine_points(
    camera_from_world: FloatArray, normalized: FloatArray, point_index: IntArray, points_world: FloatArray, steps: int = 5
) -> tuple[FloatArray, FloatArray]:
    """Points (P, 3) moved to the least squared reprojection error by Gauss-Newton, and the error (M,) of each observation on the plane z = 1.

    camera_from_world (M, 4, 4) and normalized (M, 2) belong to the M observations, point_index (M,) names the point each sees. A point that a step would
    put behind one of its cameras stays where it is.
    """
    rotation, translation = camera_from_world[:, :3, :3], camera_from_world[:, :3, 3]
    points = points_world.copy()

    def residuals(candidate: FloatArray) -> tuple[FloatArray, FloatArray]:
        seen = np.einsum("mij,mj->mi", rotation, candidate[point_index]) + translation
        with np.errstate(divide="ignore", invalid="ignore"):
            return seen, seen[:, :2] / seen[:, 2:] - normalized

    for _ in range(steps):
        seen, error = residuals(points)
        z = np.where(seen[:, 2] > 1e-9, seen[:, 2], np.inf)  # no pull from behind a camera
        rows = (rotation[:, :2] - (seen[:, :2] / z[:, None])[..., None] * rotation[:, 2:3]) / z[:, None, None]
        error = np.where(np.isfinite(z)[:, None], error, 0.0)
        normal, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        np.add.at(normal, point_index, np.einsum("mri,mrj->mij", rows, rows))
        np.add.at(right, point_index, np.einsum("mri,mr->mi", rows, error))
        normal += 1e-9 * np.maximum(np.trace(normal, axis1=1, axis2=2), 1e-12)[:, None, None] * np.eye(3)
        moved = points - np.linalg.solve(normal, right[..., None])[..., 0]
        behind = np.bincount(point_index, weights=residuals(moved)[0][:, 2] <= 1e-9, minlength=len(points)) > 0
        points = np.where(behind[:, None], points, moved)
    seen, error = residuals(points)
    return points, np.where(seen[:, 2] > 0, np.linalg.norm(error, axis=1), np.inf)


def depths(camera_from_world: FloatArray, points_world: FloatArray) -> FloatArray:
    """z (N,) of points_world (N, 3) in the camera frame."""
    return np.asarray(points_world @ camera_from_world[2, :3] + camera_from_world[2, 3])


def parallax(center0: FloatArray, center1: FloatArray, points_world: FloatArray) -> FloatArray:
    """Angle (N,) in radians at each point (N, 3) between the rays to two camera centres (3,)."""
    ray0, ray1 = center0 - points_world, center1 - points_world
    sine = np.linalg.norm(np.cross(ray0, ray1), axis=1)
    return np.asarray(np.arctan2(sine, np.einsum("ni,ni->n", ray0, ray1)))


def reprojection_errors(camera_from_world: FloatArray, points_world: FloatArray, normalized: FloatArray) -> FloatArray:
    """Distances (N,) on the plane z = 1 between projected points (N, 3) and undistorted coordinates (N, 2); inf behind the camera."""
    points = poses.apply(camera_from_world, points_world)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.linalg.norm(points[:, :2] / points[:, 2:] - normalized, axis=1)
    return np.where(points[:, 2] > 0, error, np.inf)
