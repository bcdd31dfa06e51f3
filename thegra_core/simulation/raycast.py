"""Which triangle a ray meets first: trimesh with Embree."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thegra_core.errors import InputError
from thegra_core.simulation.scene import Scene

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


class RayCaster:
    """Embree's tree over a scene's triangles.

    Raises:
        InputError: If trimesh or embreex is not installed.
    """

    def __init__(self, scene: Scene) -> None:
        try:
            import trimesh
            from trimesh.ray.ray_pyembree import RayMeshIntersector
        except ImportError as error:
            raise InputError(f"simulated scenes need trimesh and embreex ({error}); install them with: pip install trimesh embreex") from error
        mesh = trimesh.Trimesh(scene.vertices, scene.faces, process=False, validate=False)
        self._rays: Any = RayMeshIntersector(mesh)

    def first_hit(self, origins: FloatArray, directions: FloatArray) -> IntArray:
        """Index (N,) of the first triangle along rays from origins (N, 3) in directions (N, 3), -1 where there is none or a direction is NaN."""
        hits: IntArray = np.full(len(directions), -1, dtype=np.int64)
        known = np.isfinite(directions).all(axis=1)
        if known.all():
            hits[:] = self._rays.intersects_first(origins, directions)
        elif known.any():
            hits[known] = self._rays.intersects_first(origins[known], directions[known])
        return hits
