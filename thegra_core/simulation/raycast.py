"""Which triangle a ray meets first: Embree, through embreex."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thegra_core.errors import InputError
from thegra_core.simulation.scene import Scene

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


class RayCaster:
    """Embree's tree over a scene's triangles. It works in float32; who needs the exact hit meets the triangle's plane in float64.

    Raises:
        InputError: If embreex is not installed.
    """

    def __init__(self, scene: Scene) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError as error:
            raise InputError(f"simulated scenes need trimesh and embreex ({error}); install them with: pip install trimesh embreex") from error
        self._scene: Any = EmbreeScene()
        TriangleMesh(self._scene, scene.vertices.astype(np.float32), scene.faces.astype(np.int32))

    def first_hit(self, origins: FloatArray, directions: FloatArray) -> IntArray:
        """Index (N,) of the first triangle along rays from origins (N, 3) in directions (N, 3), -1 where there is none or a direction is NaN."""
        known = np.isfinite(directions).all(axis=1)
        if known.all():
            return self._run(origins, directions)
        hits: IntArray = np.full(len(directions), -1, dtype=np.int64)
        if known.any():
            hits[known] = self._run(origins[known], directions[known])
        return hits

    def _run(self, origins: FloatArray, directions: FloatArray) -> IntArray:
        hits: IntArray = np.asarray(self._scene.run(origins.astype(np.float32), directions.astype(np.float32)), dtype=np.int64)
        return hits
