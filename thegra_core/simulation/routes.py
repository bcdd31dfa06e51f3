"""Closed routes through a scene, by arc length."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

FloatArray = NDArray[np.float64]

_SAMPLES = 4000


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """Where to walk, and where to look.

    points (K, 3): the closed way, metres; no point repeats. speed_m_s: of a calm walk. gaze: "across" looks at `target` (3,), the middle of what is
    round; "ahead" looks along the way, `look_ahead_m` before the feet. room_m: the least distance to anything that the way itself keeps.
    """

    points: FloatArray
    speed_m_s: float
    gaze: Literal["across", "ahead"]
    room_m: float
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    look_ahead_m: float = 2.5


class Way:
    """A smooth closed curve through a route's points, by arc length (periodic cubic spline: continuous curvature)."""

    def __init__(self, route: Route) -> None:
        closed = np.concatenate([route.points, route.points[:1]])
        chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
        self._curve: Callable[[FloatArray], FloatArray] = CubicSpline(chord, closed, bc_type="periodic")
        self._parameter = np.linspace(0.0, chord[-1], _SAMPLES)
        steps = np.linalg.norm(np.diff(self._curve(self._parameter), axis=0), axis=1)
        self._arc = np.concatenate([[0.0], np.cumsum(steps)])
        self.length_m = float(self._arc[-1])

    def at(self, arc_m: ArrayLike) -> FloatArray:
        """Points (N, 3) at arc lengths (N,), which go round."""
        wrapped = np.mod(np.asarray(arc_m, dtype=np.float64), self.length_m)
        points: FloatArray = np.array(self._curve(np.interp(wrapped, self._arc, self._parameter)), dtype=np.float64)
        return points


def rounded_rectangle(width: float, depth: float, radius: float, height: float, step_m: float = 0.5) -> FloatArray:
    """Points (K, 3) along a rectangle centred on the origin with round corners, counter-clockwise, about `step_m` apart."""
    centers = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (np.array([width, depth]) / 2 - radius)
    points: list[FloatArray] = []
    for quarter, center in enumerate(centers):
        angles = quarter * np.pi / 2 + np.linspace(0, np.pi / 2, max(3, round(radius * np.pi / 2 / step_m) + 1))
        corner = center + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        following = centers[(quarter + 1) % 4] + radius * np.array([np.cos(angles[-1]), np.sin(angles[-1])])
        count = max(1, round(float(np.linalg.norm(following - corner[-1])) / step_m))
        straight = corner[-1] + np.linspace(0, 1, count, endpoint=False)[1:, None] * (following - corner[-1])
        points += [corner, straight]
    flat = np.concatenate(points)
    return np.concatenate([flat, np.full((len(flat), 1), height)], axis=1)
