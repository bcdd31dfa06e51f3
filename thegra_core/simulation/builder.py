"""Puts scenes together from rectangles, boxes, cylinders, ellipsoids and meshes; every piece gets a texture of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thegra_core.simulation.scene import Scene, Sky, Surface

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_RING = 20  # segments of a cylinder
_OUT_OF_LATTICE = 0.37  # third coordinate of flat faces


class SceneBuilder:
    """Collects triangles; `scene()` gives the frozen result. The random generator decides temperatures and textures only where a method says so."""

    def __init__(self, name: str, seed: int) -> None:
        self.name = name
        self.rng = np.random.default_rng([seed, sum(name.encode())])
        self._vertices: list[FloatArray] = []
        self._faces: list[IntArray] = []
        self._surface_of_face: list[IntArray] = []
        self._place: list[FloatArray] = []
        self._offset_k: list[FloatArray] = []
        self._rows: list[tuple[float, ...]] = []
        self._count = 0

    def mesh(self, vertices: FloatArray, faces: IntArray, surface: Surface, place: FloatArray, offset_k: FloatArray | None = None, flat: bool = False) -> None:
        """Add triangles: vertices (V, 3), faces (F, 3), place (V, 3) coordinates on the surface, offset_k (V,) kelvin."""
        self._faces.append(np.asarray(faces, dtype=np.int64) + self._count)
        self._vertices.append(np.asarray(vertices, dtype=np.float64))
        self._place.append(np.asarray(place, dtype=np.float64))
        self._offset_k.append(np.zeros(len(vertices)) if offset_k is None else np.asarray(offset_k, dtype=np.float64))
        self._surface_of_face.append(np.full(len(faces), len(self._rows), dtype=np.int64))
        self._rows.append(surface.row(flat, int(self.rng.integers(1, 2**20))))
        self._count += len(vertices)

    def quad(self, corner: ArrayLike, along_u: ArrayLike, along_v: ArrayLike, surface: Surface, offset_k: Sequence[float] = (0.0, 0.0, 0.0, 0.0)) -> None:
        """Add the rectangle with a corner and two edges (3,); `offset_k` at the corners 0, u, v, u + v."""
        origin, u, v = (np.asarray(value, dtype=np.float64) for value in (corner, along_u, along_v))
        width, height = np.linalg.norm(u), np.linalg.norm(v)
        place = np.array([[0, 0], [width, 0], [0, height], [width, height]])
        vertices = np.stack([origin, origin + u, origin + v, origin + u + v])
        self.mesh(vertices, np.array([[0, 1, 3], [0, 3, 2]]), surface, np.c_[place, np.full(4, _OUT_OF_LATTICE)], np.asarray(offset_k), flat=True)

    def box(self, base: ArrayLike, size: ArrayLike, surface: Surface, yaw: float = 0.0, spread_k: float = 0.1, top: Surface | None = None) -> None:
        """Add an upright box: `base` (3,) is the middle of its bottom, `size` (x, y, z) metres before it turns by `yaw` rad; faces differ by random +-spread_k."""
        c, s = np.cos(yaw), np.sin(yaw)
        x, y, z = np.array([c, s, 0.0]), np.array([-s, c, 0.0]), np.array([0.0, 0.0, 1.0])
        dx, dy, dz = np.asarray(size, dtype=np.float64)
        low = np.asarray(base, dtype=np.float64) - 0.5 * dx * x - 0.5 * dy * y
        far = low + dx * x + dy * y + dz * z
        sides = ((low, dx * x, dz * z), (low, dy * y, dz * z), (far, -dx * x, -dz * z), (far, -dy * y, -dz * z), (low, dx * x, dy * y), (far, -dx * x, -dy * y))
        for number, (corner, along_u, along_v) in enumerate(sides):
            material = top if top is not None and number == 5 else surface
            self.quad(corner, along_u, along_v, replace(material, kelvin=material.kelvin + self.rng.uniform(-spread_k, spread_k)))

    def cylinder(self, start: ArrayLike, end: ArrayLike, radius: float, surface: Surface, ring: int = _RING, caps: bool = True, radius_end: float | None = None) -> None:
        """Add a cylinder, or a cone with another `radius_end`, between two points (3,)."""
        a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
        length = float(np.linalg.norm(b - a))
        across = np.cross(b - a, [0.0, 0.0, 1.0] if abs(b[2] - a[2]) < 0.9 * length else [1.0, 0.0, 0.0])
        x = across / np.linalg.norm(across)
        y = np.cross((b - a) / length, x)
        angles = np.linspace(0, 2 * np.pi, ring, endpoint=False)
        circle = np.cos(angles)[:, None] * x + np.sin(angles)[:, None] * y
        last = radius if radius_end is None else radius_end
        i, j = np.arange(ring), (np.arange(ring) + 1) % ring
        faces = np.concatenate([np.stack([i, j, j + ring], axis=1), np.stack([i, j + ring, i + ring], axis=1)])
        vertices = np.concatenate([a + radius * circle, b + last * circle])
        if caps:
            faces = np.concatenate([faces, np.stack([i, j, np.full(ring, 2 * ring)], axis=1), np.stack([i + ring, j + ring, np.full(ring, 2 * ring + 1)], axis=1)])
            vertices = np.concatenate([vertices, a[None], b[None]])
        self.mesh(vertices, faces, surface, vertices - a)

    def ellipsoid(self, center: ArrayLike, radii: ArrayLike, surface: Surface, yaw: float = 0.0, rough_m: float = 0.0, subdivisions: int = 3) -> None:
        """Add an ellipsoid, its surface displaced by noise of +-rough_m metres (for foliage and rocks)."""
        import trimesh

        from thegra_core.simulation.texture import noise3_many

        sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
        unit, semi_axes = np.asarray(sphere.vertices, dtype=np.float64), np.asarray(radii, dtype=np.float64)
        points = unit * semi_axes
        if rough_m > 0:
            points = points + unit * 2.0 * rough_m * noise3_many(points / max(0.35 * float(semi_axes.min()), 0.1), int(self.rng.integers(1, 2**20)))[:, None]
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        self.mesh(points @ turn.T + np.asarray(center, dtype=np.float64), np.asarray(sphere.faces), surface, points)

    def scene(self, sky: Sky, ambient_k: float) -> Scene:
        """The finished scene."""
        return Scene(
            self.name, np.concatenate(self._vertices), np.concatenate(self._faces), np.concatenate(self._surface_of_face), np.concatenate(self._place),
            np.concatenate(self._offset_k), np.array(self._rows), sky, ambient_k,
        )  # fmt: skip
