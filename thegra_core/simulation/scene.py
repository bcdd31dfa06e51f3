"""Scenes of flat, textured rectangles.

World: z up, metres. A texture is a function of face coordinates (metres): the bilinear interpolation of a grid that holds a sum of smooth
blobs and soft-edged patches, so that every view of a face shows the same function.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

COUNTS = 7000.0
"""Mean raw level of a scene near 20 degrees Celsius, as uncooled 14-bit cameras give it."""
_GRID_PER_M = 64.0
_EDGE_M = 0.012  # width of a patch's soft edge: about the least that the grid still holds


@dataclass(frozen=True, slots=True, eq=False)
class Texture:
    """Raw counts over a face: `grid` (rows, columns) float64 at `per_m` samples a metre; row 0 is v = 0, column 0 is u = 0."""

    grid: FloatArray
    per_m: float = _GRID_PER_M

    def sample(self, u: FloatArray, v: FloatArray) -> FloatArray:
        """Counts (N,) at face coordinates u, v (N,) metres; beyond the grid its border's value."""
        rows, columns = self.grid.shape
        x = np.clip(u * self.per_m, 0.0, columns - 1.000001)
        y = np.clip(v * self.per_m, 0.0, rows - 1.000001)
        x0, y0 = x.astype(np.intp), y.astype(np.intp)
        fx, fy = x - x0, y - y0
        flat = self.grid.ravel()
        index = y0 * columns + x0
        top = flat[index] * (1 - fx) + flat[index + 1] * fx
        bottom = flat[index + columns] * (1 - fx) + flat[index + columns + 1] * fx
        return np.asarray(top * (1 - fy) + bottom * fy)


@dataclass(frozen=True, slots=True, eq=False)
class Face:
    """A rectangle seen from both sides: corner `origin` (3,), unit axes `u` and `v` (3,), `size` (along u, along v) metres."""

    origin: FloatArray
    u: FloatArray
    v: FloatArray
    size: tuple[float, float]
    texture: Texture

    def points(self, uv: ArrayLike) -> FloatArray:
        """World points (N, 3) of face coordinates (N, 2)."""
        uv = np.asarray(uv, dtype=np.float64).reshape(-1, 2)
        return np.asarray(self.origin + uv[:, :1] * self.u + uv[:, 1:] * self.v)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Faces, and the counts seen where a ray meets none."""

    faces: tuple[Face, ...]
    background: float = COUNTS - 400.0


def room(seed: int = 0, size: tuple[float, float, float] = (8.0, 6.0, 3.0), boxes: int = 9) -> Scene:
    """A closed room of `size` (x, y, z) metres, corner at the origin, with `boxes` warm and cool boxes along the wall x = size[0] and on the floor before it."""
    rng = np.random.default_rng(seed)
    width, depth, height = size
    faces = list(_box_faces(rng, np.zeros(3), np.array(size), 0.0, COUNTS, contrast=220.0))
    for _ in range(boxes):
        extent = rng.uniform([0.4, 0.4, 0.4], [1.0, 1.0, 1.9])
        corner = np.array([rng.uniform(0.55 * width, width - 1.2), rng.uniform(0.2, depth - 1.2), 0.0])
        if rng.random() < 0.3:  # a cupboard on the wall: parallax above the floor too
            corner[2] = rng.uniform(0.8, height - 1.0)
            extent[2] = min(extent[2], height - corner[2])
        faces += _box_faces(rng, corner, extent, rng.uniform(-0.6, 0.6), COUNTS + rng.uniform(-150, 250), contrast=260.0)
    return Scene(tuple(faces))


def plane(seed: int = 0, size: tuple[float, float] = (12.0, 12.0)) -> Scene:
    """One textured rectangle in the plane z = 0, centred on the origin: a scene in which a homography explains everything."""
    rng = np.random.default_rng(seed)
    origin = np.array([-size[0] / 2, -size[1] / 2, 0.0])
    return Scene((Face(origin, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), size, random_texture(rng, size, COUNTS, 260.0)),))


SCENES: dict[str, Callable[[int], Scene]] = {"room": room, "plane": plane}


def random_texture(rng: np.random.Generator, size: tuple[float, float], level: float, contrast: float) -> Texture:
    """Texture of a face of `size` metres: mean about `level` counts, standard deviation `contrast` counts."""
    columns, rows = (int(np.ceil(length * _GRID_PER_M)) + 2 for length in size)
    grid = np.zeros((rows, columns))
    area = size[0] * size[1]
    for least, most, density, weight in ((0.25, 0.7, 1.5, 0.8), (0.06, 0.2, 14.0, 0.7), (0.025, 0.05, 45.0, 0.9)):
        count = max(2, round(density * area))
        _add_blobs(grid, rng.uniform([0, 0], size, (count, 2)), rng.uniform(least, most, count), weight * rng.standard_normal(count))
    for _ in range(max(2, round(9.0 * area))):
        _add_patch(grid, rng.uniform([0, 0], size), rng.uniform(0.04, 0.25, 2), rng.uniform(0, np.pi), 0.9 * rng.standard_normal())
    grid -= grid.mean()
    return Texture(level + contrast * grid / max(float(grid.std()), 1e-9))


def _add_blobs(grid: FloatArray, centers: FloatArray, sigmas: FloatArray, amplitudes: FloatArray) -> None:
    for center, sigma, amplitude in zip(centers, sigmas, amplitudes, strict=True):
        window, u, v = _window(grid, center, 3.5 * sigma)
        window += amplitude * np.exp(-((v - center[1]) ** 2) / (2 * sigma**2)) * np.exp(-((u - center[0]) ** 2) / (2 * sigma**2))


def _add_patch(grid: FloatArray, center: FloatArray, half: FloatArray, angle: float, amplitude: float) -> None:
    window, u, v = _window(grid, center, float(np.hypot(*half)) + 4 * _EDGE_M)
    along = (u - center[0]) * np.cos(angle) + (v - center[1]) * np.sin(angle)
    across = (v - center[1]) * np.cos(angle) - (u - center[0]) * np.sin(angle)
    window += amplitude * _soft_step(half[0] - np.abs(along)) * _soft_step(half[1] - np.abs(across))


def _soft_step(distance: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (1 + np.tanh(distance / _EDGE_M)))


def _window(grid: FloatArray, center: FloatArray, radius: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """View of the grid within `radius` of `center`, and the u (1, C) and v (R, 1) of its samples."""
    low = np.maximum(np.floor((center - radius) * _GRID_PER_M).astype(int), 0)
    high = np.ceil((center + radius) * _GRID_PER_M).astype(int) + 1
    view = grid[low[1] : high[1], low[0] : high[0]]
    return view, (low[0] + np.arange(view.shape[1]))[None, :] / _GRID_PER_M, (low[1] + np.arange(view.shape[0]))[:, None] / _GRID_PER_M


def _box_faces(
    rng: np.random.Generator, corner: FloatArray, extent: FloatArray, yaw: float, level: float, contrast: float
) -> Sequence[Face]:
    """Six faces of an upright box turned by `yaw` rad about the vertical through `corner`; each has its own temperature."""
    x, y, z = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([-np.sin(yaw), np.cos(yaw), 0.0]), np.array([0.0, 0.0, 1.0])
    dx, dy, dz = extent
    far = corner + dx * x + dy * y + dz * z
    sides = [(corner, x, z, dx, dz), (corner, y, z, dy, dz), (corner, x, y, dx, dy), (far, -x, -z, dx, dz), (far, -y, -z, dy, dz), (far, -x, -y, dx, dy)]
    return [
        Face(origin, u, v, (float(lu), float(lv)), random_texture(rng, (float(lu), float(lv)), level + rng.uniform(-60, 60), contrast))
        for origin, u, v, lu, lv in sides
    ]
