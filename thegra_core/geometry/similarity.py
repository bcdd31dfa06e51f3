"""Similarities of 3-D space, Sim(3): a rotation, a translation and a scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry import poses

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Similarity:
    """a_from_b: x_a = scale * R x_b + t, with rigid (4, 4) holding R and t."""

    rigid: FloatArray
    scale: float = 1.0

    def __matmul__(self, other: Similarity) -> Similarity:
        """a_from_b @ b_from_c = a_from_c."""
        rotation = self.rigid[:3, :3] @ other.rigid[:3, :3]
        translation = self.scale * self.rigid[:3, :3] @ other.rigid[:3, 3] + self.rigid[:3, 3]
        return Similarity(poses.transform(rotation, translation), self.scale * other.scale)

    def inverse(self) -> Similarity:
        """b_from_a."""
        rotation = self.rigid[:3, :3].T
        return Similarity(poses.transform(rotation, -rotation @ self.rigid[:3, 3] / self.scale), 1.0 / self.scale)

    def apply(self, points: FloatArray) -> FloatArray:
        """Points (N, 3) of b in a."""
        return np.asarray(self.scale * points @ self.rigid[:3, :3].T + self.rigid[:3, 3])
