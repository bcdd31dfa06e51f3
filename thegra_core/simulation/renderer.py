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
    height, width = rays.shape[:2]
    directions = rays.reshape(-1, 3)
    depth = np.full(len(directions), np.inf)
    counts = np.full(len(directions), scene.background)
    for face in scene.faces:
        _draw(face, directions, world_from_camera, depth, counts)
    if noise_counts > 0:
        if rng is None:
            raise ValueError("noise needs a random generator: pass rng=numpy.random.default_rng(seed)")
        counts += noise_counts * rng.standard_normal(len(counts))
    image = np.clip(np.rint(counts), 0, 65535).astype(np.uint16).reshape(height, width)
    return Rendering(image, depth.reshape(height, width))


def _draw(face: Face, directions: FloatArray, world_from_camera: FloatArray, depth: FloatArray, counts: FloatArray) -> None:
    """Draw a face over what is farther; `depth` and `counts` (N,) change in place.

    In face axes (u, v, n) a ray is center + z * axes @ direction, so the plane n = 0 is met at z = -center_n / (axes_n . direction).
    """
    axes_from_world = np.stack([face.u, face.v, np.cross(face.u, face.v)])
    center = axes_from_world @ (world_from_camera[:3, 3] - face.origin)
    axes_from_camera = axes_from_world @ world_from_camera[:3, :3]
    if abs(center[2]) < _NEAR_M or not _may_be_seen(face, world_from_camera):
        return
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        z = -center[2] / (directions @ axes_from_camera[2])
        candidates = np.flatnonzero((z > _NEAR_M) & (z < depth))
        rays, z = directions[candidates], z[candidates]
        u = center[0] + z * (rays @ axes_from_camera[0])
        v = center[1] + z * (rays @ axes_from_camera[1])
    hit = (u >= 0) & (u <= face.size[0]) & (v >= 0) & (v <= face.size[1])
    index = candidates[hit]
    depth[index] = z[hit]
    counts[index] = face.texture.sample(u[hit], v[hit])


def _may_be_seen(face: Face, world_from_camera: FloatArray) -> bool:
    """Whether any part of a face lies before the camera."""
    width, height = face.size
    corners = face.points([[0, 0], [width, 0], [0, height], [width, height]])
    return bool(np.any((corners - world_from_camera[:3, 3]) @ world_from_camera[:3, 2] > _NEAR_M))
