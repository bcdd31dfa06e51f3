"""A scene as a thermal camera's optics see it: one ray a pixel through the camera's own distortion, four at edges, and exact depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry.camera import CameraModel
from thegra_core.simulation.raycast import RayCaster
from thegra_core.simulation.scene import Scene
from thegra_core.simulation.shading import shade

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_SUBPIXELS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
_DEPTH_STEP = 0.04  # relative step of depth between neighbours that counts as an edge
_LIFT_M = 1e-4  # reflected rays start this far above their mirror


@dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """kelvin (H, W) float64 apparent temperature; depth (H, W) float64, z in the camera frame in metres, inf where a ray meets nothing."""

    kelvin: FloatArray
    depth: FloatArray


def pixel_rays(camera: CameraModel, shift: tuple[float, float] = (0.0, 0.0)) -> FloatArray:
    """Rays (H, W, 3) through the pixels' centres moved by `shift` px, scaled to z = 1 in the camera frame; NaN where the distortion has no inverse."""
    width, height = camera.image_size
    x, y = np.meshgrid(np.arange(width, dtype=np.float64) + shift[0], np.arange(height, dtype=np.float64) + shift[1])
    normalized = camera.undistort(np.stack([x.ravel(), y.ravel()], axis=1))
    return np.concatenate([normalized, np.ones((len(normalized), 1))], axis=1).reshape(height, width, 3)


class Renderer:
    """Renders one scene through one camera; the rays and Embree's tree are made once."""

    def __init__(self, scene: Scene, camera: CameraModel) -> None:
        self.scene = scene
        self.camera = camera
        self._caster = RayCaster(scene)
        self._rays = pixel_rays(camera)
        self._subpixel_rays = [pixel_rays(camera, shift).reshape(-1, 3) for shift in _SUBPIXELS]
        self._triangles = np.ascontiguousarray(scene.vertices[scene.faces])
        self._places = np.ascontiguousarray(scene.place[scene.faces])
        self._offsets = np.ascontiguousarray(scene.offset_k[scene.faces])
        self._sky = (scene.sky.horizon_k, scene.sky.zenith_k, scene.sky.clouds_k)
        self._pixel_rad = 1.0 / camera.focal

    def render(self, world_from_camera: FloatArray) -> Rendering:
        """Apparent temperature and depth from a pose (4, 4), or from a pose for each row (H, 4, 4) of a camera that reads out row by row."""
        height, width = self._rays.shape[:2]
        poses = np.broadcast_to(world_from_camera, (height, 4, 4))
        origins = np.repeat(poses[:, :3, 3], width, axis=0)
        directions = np.matmul(self._rays, poses[:, :3, :3].transpose(0, 2, 1)).reshape(-1, 3)
        kelvin, depth, hits = self._trace(origins, directions)
        edges = np.flatnonzero(self._edges(hits.reshape(height, width), depth.reshape(height, width)))
        if len(edges):
            rotations, starts = poses[edges // width, :3, :3], origins[edges]
            samples = [self._trace(starts, np.einsum("nij,nj->ni", rotations, rays[edges]))[0] for rays in self._subpixel_rays]
            kelvin[edges] = np.mean(samples, axis=0)
        return Rendering(kelvin.reshape(height, width), depth.reshape(height, width))

    def _trace(self, origins: FloatArray, directions: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
        """Kelvin (N,), distance (N,) in lengths of the directions, and triangle (N,) of rays, with one bounce off mirrors."""
        hits = self._caster.first_hit(origins, directions)
        kelvin, distance, reflected, normals = self._shade(origins, directions, hits, np.zeros(len(hits)))
        mirrors = np.flatnonzero(reflected)
        if len(mirrors):
            incoming = directions[mirrors] / np.linalg.norm(directions[mirrors], axis=1, keepdims=True)
            normal = normals[mirrors]
            bounced = incoming - 2 * np.einsum("ni,ni->n", incoming, normal)[:, None] * normal
            starts = origins[mirrors] + directions[mirrors] * distance[mirrors, None] + _LIFT_M * normal
            way = distance[mirrors] * np.linalg.norm(directions[mirrors], axis=1)
            seen, _, _, _ = self._shade(starts, bounced, self._caster.first_hit(starts, bounced), way, mirrors_as=self.scene.ambient_k)
            kelvin[mirrors] += reflected[mirrors] * seen
        return kelvin, distance, hits

    def _shade(
        self, origins: FloatArray, directions: FloatArray, hits: IntArray, path_m: FloatArray, mirrors_as: float | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        count = len(hits)
        kelvin, distance, reflected, normals = np.empty(count), np.empty(count), np.empty(count), np.zeros((count, 3))
        shade(
            origins, directions, hits, self._triangles, self._places, self._offsets, self.scene.surface_of_face, self.scene.surfaces,
            self._sky, self.scene.ambient_k, self._pixel_rad, path_m, kelvin, distance, reflected, normals,
        )  # fmt: skip
        if mirrors_as is not None:
            kelvin += reflected * mirrors_as
        return kelvin, distance, reflected, normals

    def _edges(self, hits: IntArray, depth: FloatArray) -> NDArray[np.bool_]:
        """(H * W,) whether a neighbour shows another surface or another depth."""
        surface = np.where(hits >= 0, self.scene.surface_of_face[hits], -1)
        near = 1.0 / depth
        edges = np.zeros(hits.shape, dtype=bool)
        for this, that in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
            differs = (surface[this] != surface[that]) | (np.abs(near[this] - near[that]) > _DEPTH_STEP * np.maximum(near[this], near[that]))
            edges[this] |= differs
            edges[that] |= differs
        return edges.ravel()
