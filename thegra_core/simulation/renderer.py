"""A scene as a thermal camera's optics see it: one ray a pixel through the camera's own distortion, four at edges, and exact depth."""

from __future__ import annotations

import itertools
import os
from concurrent.futures import ThreadPoolExecutor
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
_THREADS = min(4, os.cpu_count() or 1)  # shading lets others run meanwhile; what a ray sees does not depend on their number
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
        self._pool = ThreadPoolExecutor(_THREADS)
        self._rays = pixel_rays(camera)
        self._subpixel_rays = [pixel_rays(camera, shift) for shift in _SUBPIXELS]
        self._triangles = np.ascontiguousarray(scene.vertices[scene.faces])
        self._places = np.ascontiguousarray(scene.place[scene.faces])
        self._offsets = np.ascontiguousarray(scene.offset_k[scene.faces])
        self._sky = (scene.sky.horizon_k, scene.sky.zenith_k, scene.sky.clouds_k)
        self._pixel_rad = 1.0 / camera.focal

    def render(self, world_from_camera: FloatArray, smooth_edges: bool = True) -> Rendering:
        """Apparent temperature and depth from a pose (4, 4), or from a pose for each row (H, 4, 4) of a camera that reads out row by row.

        With `smooth_edges`, pixels beside an edge are the mean of four rays.
        """
        poses, origins, directions = self._rays_from(world_from_camera, self._rays)
        height, width = self._rays.shape[:2]
        kelvin, depth, hits = self._trace(origins, directions)
        edges = np.flatnonzero(self._edges(hits.reshape(height, width), depth.reshape(height, width))) if smooth_edges else np.array([], np.intp)
        if len(edges):
            rotations, starts = poses[edges // width, :3, :3], origins[edges]
            samples = [self._trace(starts, np.einsum("nij,nj->ni", rotations, rays.reshape(-1, 3)[edges]))[0] for rays in self._subpixel_rays]
            kelvin[edges] = np.mean(samples, axis=0)
        return Rendering(kelvin.reshape(height, width), depth.reshape(height, width))

    def render_part(self, world_from_camera: FloatArray, part: int) -> FloatArray:
        """Apparent temperature (H, W) through the middles of one quarter of each pixel; `part` goes round. The mean of all four is smooth at edges."""
        _, origins, directions = self._rays_from(world_from_camera, self._subpixel_rays[part % len(_SUBPIXELS)])
        return self._trace(origins, directions)[0].reshape(self._rays.shape[:2])

    def depth_along(self, rays: FloatArray, world_from_camera: FloatArray, farthest_m: float = 1e4) -> FloatArray:
        """Depth (N,) along rays (N, 3) with z = 1 in the camera frame, `farthest_m` at the most."""
        directions = rays @ world_from_camera[:3, :3].T
        return np.minimum(self._trace(np.tile(world_from_camera[:3, 3], (len(rays), 1)), directions)[1], farthest_m)

    def _rays_from(self, world_from_camera: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Pose of each row (H, 4, 4), origins and directions (H * W, 3) in the world."""
        height, width = rays.shape[:2]
        poses = np.broadcast_to(world_from_camera, (height, 4, 4))
        directions = np.matmul(rays, poses[:, :3, :3].transpose(0, 2, 1)).reshape(-1, 3)
        return poses, np.repeat(poses[:, :3, 3], width, axis=0), directions

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

        def part(rays: slice) -> None:
            shade(
                origins[rays], directions[rays], hits[rays], self._triangles, self._places, self._offsets, self.scene.surface_of_face, self.scene.surfaces,
                self._sky, self.scene.ambient_k, self._pixel_rad, path_m[rays], kelvin[rays], distance[rays], reflected[rays], normals[rays],
            )  # fmt: skip

        bounds = np.linspace(0, count, _THREADS + 1).astype(int)
        list(self._pool.map(part, (slice(low, high) for low, high in itertools.pairwise(bounds.tolist()))))
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
