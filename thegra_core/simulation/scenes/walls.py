"""Places on walls: along, up, out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thegra_core.simulation.builder import SceneBuilder
from thegra_core.simulation.scene import Surface

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Wall:
    """An upright wall from `start` (2,) on for `length` metres at an angle of `yaw` rad; its front is on the left of that direction."""

    start: FloatArray
    yaw: float
    length: float

    def at(self, along: float, up: float = 0.0, out: float = 0.0) -> FloatArray:
        """World point (3,): metres along the wall, above the ground, and before its front."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([self.start[0] + c * along - s * out, self.start[1] + s * along + c * out, up])

    def front(self, b: SceneBuilder, height: float, surface: Surface, lap: float = 0.0, offset_k: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)) -> None:
        """Add its face up to `height`, reaching `lap` metres beyond its edges."""
        corner = self.at(-lap, -lap)
        b.quad(corner, self.at(self.length + lap, -lap) - corner, [0.0, 0.0, height + 2 * lap], surface, offset_k)

    def box(self, b: SceneBuilder, along: float, up: float, size: tuple[float, float, float], surface: Surface, spread_k: float = 0.1, out: float = 0.0) -> None:
        """Add a box that stands on the wall: `size` along, out, up; `along` is its middle, `up` its bottom."""
        b.box(self.at(along, up, out + size[1] / 2), size, surface, self.yaw, spread_k)


def around(width: float, depth: float, outwards: bool) -> tuple[Wall, Wall, Wall, Wall]:
    """The four walls of a rectangle centred on the origin, fronts outwards or inwards."""
    corners = np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]]) * np.array([width, depth]) / 2
    walls = []
    for k in range(4):
        a, c = corners[k], corners[(k + 1) % 4]
        start, end = (c, a) if outwards else (a, c)
        direction = end - start
        walls.append(Wall(start, float(np.arctan2(direction[1], direction[0])), float(np.linalg.norm(direction))))
    return walls[0], walls[1], walls[2], walls[3]
