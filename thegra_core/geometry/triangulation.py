"""Points from posed views, and the quantities that say whether to believe them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry import poses

FloatArray = NDArray[np.float64]


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
