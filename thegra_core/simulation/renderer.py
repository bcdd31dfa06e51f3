"""Renders a scene as a thermal camera sees it: one ray a pixel, through the camera's own distortion, and exact depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry.camera import CameraModel
from thegra_core.simulation.scene import Face, Scene

FloatArray = NDArray[np.float64]
_NEAR_M = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """image (H, W) uint16 raw counts; depth (H, W) float64, z in the camera frame in metres, inf where a ray meets nothing."""

    image: NDArray[np.uint16]
    depth: FloatArray


def pixel_rays(camera: CameraModel) -> FloatArray:
    """Rays (H, W, 3) through the pixels' centres, scaled to z = 1 in the camera frame; NaN where the distortion has no inverse.

    They depend on the camera only: compute them once for a recording.
    """
    width, height = camera.image_size
    x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    normalized = camera.undistort(np.stack([x.ravel(), y.ravel()], axis=1))
    return np.concatenate([normalized, np.ones((len(normalized), 1))], axis=1).reshape(height, width, 3)


def render(
    scene: Scene, rays: FloatArray, world_from_camera: FloatArray, noise_counts: float = 0.0, rng: np.random.Generator | None = None
) -> Rendering:
    """Image and depth of a scene from a pose.

    Args:
        rays: (H, W, 3) of `pixel_rays`.
        world_from_camera: (4, 4), optical camera frame.
        noise_counts: Standard deviation of white temporal noise, in counts.
        rng: Source of the noise; needed when `noise_counts` is not 0.
    """
    depth = np.full(rays.shape[:2], np.inf)
    counts = np.full(rays.shape[:2], scene.background)
    bounds = _ray_bounds(rays)
    for face in scene.faces:
        window = _window(face, world_from_camera, bounds)
        _draw(face, rays[window], world_from_camera, depth[window], counts[window])
    if noise_counts > 0:
        if rng is None:
            raise ValueError("noise needs a random generator: pass rng=numpy.random.default_rng(seed)")
        counts += noise_counts * rng.standard_normal(counts.shape)
    return Rendering(np.clip(np.rint(counts), 0, 65535).astype(np.uint16), depth)


def _draw(face: Face, rays: FloatArray, world_from_camera: FloatArray, depth: FloatArray, counts: FloatArray) -> None:
    """Draw a face over what is farther; `depth` and `counts` (H, W) change in place.

    In face axes (u, v, n) a ray is center + z * axes @ ray, so the plane n = 0 is met at z = -center_n / (axes_n . ray).
    """
    axes_from_world = np.stack([face.u, face.v, np.cross(face.u, face.v)])
    center = axes_from_world @ (world_from_camera[:3, 3] - face.origin)
    axes_from_camera = axes_from_world @ world_from_camera[:3, :3]
    if depth.size == 0 or abs(center[2]) < _NEAR_M:
        return
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        z = -center[2] / (rays @ axes_from_camera[2])
        candidates = np.nonzero((z > _NEAR_M) & (z < depth))
        z = z[candidates]
        u, v = (center[:2, None] + z * (rays[candidates] @ axes_from_camera[:2].T).T)
    hit = (u >= 0) & (u <= face.size[0]) & (v >= 0) & (v <= face.size[1])
    pixels = candidates[0][hit], candidates[1][hit]
    depth[pixels] = z[hit]
    counts[pixels] = face.texture.sample(u[hit], v[hit])


def _ray_bounds(rays: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Least and greatest x of each image column (W,) and y of each row (H,)."""
    x, y = rays[..., 0], rays[..., 1]
    low, high = np.inf, -np.inf
    known = np.isfinite(x)
    return (
        np.min(x, axis=0, where=known, initial=low),
        np.max(x, axis=0, where=known, initial=high),
        np.min(y, axis=1, where=known, initial=low),
        np.max(y, axis=1, where=known, initial=high),
    )


def _window(face: Face, world_from_camera: FloatArray, bounds: tuple[FloatArray, FloatArray, FloatArray, FloatArray]) -> tuple[slice, slice]:
    """Rows and columns outside of which a face is not seen; all of them when it reaches behind the camera."""
    width, height = face.size
    corners = (face.points([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]]) - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
    if np.all(corners[:, 2] <= _NEAR_M):
        return slice(0), slice(0)
    if np.any(corners[:, 2] <= _NEAR_M):
        return slice(None), slice(None)
    projected = corners[:, :2] / corners[:, 2:]
    (x_low, y_low), (x_high, y_high) = projected.min(axis=0), projected.max(axis=0)
    columns = np.flatnonzero((bounds[0] <= x_high) & (bounds[1] >= x_low))
    rows = np.flatnonzero((bounds[2] <= y_high) & (bounds[3] >= y_low))
    if not len(rows) or not len(columns):
        return slice(0), slice(0)
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
