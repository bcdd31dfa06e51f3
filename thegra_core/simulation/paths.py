"""Smooth camera paths in closed form: `world_from_camera` at any time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry.poses import transform

FloatArray = NDArray[np.float64]
Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class SwayPath:
    """A camera that sways about a point while it looks at another point that sways too.

    Each coordinate is center + amplitude * sin(2 pi t / period), world axes, metres and seconds; `roll` (amplitude rad, period s) turns
    the image about the optical axis. At t = 0 the camera is at `center`.
    """

    center: Triple
    amplitude: Triple
    period_s: Triple
    target: Triple
    target_amplitude: Triple = (0.0, 0.0, 0.0)
    target_period_s: Triple = (9.0, 11.0, 7.0)
    roll: tuple[float, float] = (0.0, 8.0)

    def world_from_camera(self, t_s: float) -> FloatArray:
        """Pose (4, 4) at `t_s` seconds."""
        position = _sway(self.center, self.amplitude, self.period_s, t_s)
        target = _sway(self.target, self.target_amplitude, self.target_period_s, t_s)
        return look_at(position, target, self.roll[0] * np.sin(2 * np.pi * t_s / self.roll[1]))


ROOM_PATH = SwayPath(
    center=(2.2, 2.6, 1.4),
    amplitude=(0.8, 1.5, 0.35),
    period_s=(13.0, 16.0, 7.0),
    target=(6.8, 3.0, 1.1),
    target_amplitude=(0.0, 0.7, 0.25),
    roll=(0.08, 9.0),
)
"""Through the room of `scene.room`, sideways first, so that parallax comes early."""

PLANE_PATH = SwayPath(
    center=(0.0, -0.8, 3.0), amplitude=(1.2, 0.5, 0.3), period_s=(14.0, 11.0, 8.0), target=(0.0, 0.6, 0.0), target_amplitude=(0.6, 0.3, 0.0), roll=(0.05, 9.0)
)
"""Over the plane of `scene.plane`, looking down at a slant."""

PATHS = {"room": ROOM_PATH, "plane": PLANE_PATH}


def look_at(position: Sequence[float] | FloatArray, target: Sequence[float] | FloatArray, roll: float = 0.0) -> FloatArray:
    """Pose (4, 4) of a camera at `position` that looks at `target`, image upright in a world with z up, then rolled by `roll` rad about its axis.

    Raises:
        ValueError: If it looks straight up or down, where upright means nothing.
    """
    position, target = np.asarray(position, dtype=np.float64), np.asarray(target, dtype=np.float64)
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-9:
        raise ValueError("the camera looks straight up or down: move the target sideways")
    right = right / np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    rotation = np.stack([c * right + s * down, c * down - s * right, forward], axis=1)
    return transform(rotation, position)


def _sway(center: Triple, amplitude: Triple, period_s: Triple, t_s: float) -> FloatArray:
    return np.asarray(np.array(center) + np.array(amplitude) * np.sin(2 * np.pi * t_s / np.array(period_s)))
