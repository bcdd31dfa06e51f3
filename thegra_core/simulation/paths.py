"""Hand-held camera paths in six degrees of freedom: C2 in time, in the paper's three styles.

A path follows a closed route at a pace that varies a little, so it comes back to places seen before. On it ride slow swings of the gaze, and the
tremor of a hand as a sum of sines.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from thegra_core.simulation.routes import Route, Way

FloatArray = NDArray[np.float64]
StyleName = Literal["robust", "unstable", "aggressive"]

_KNOT_S = 0.25
_MARGIN_S = 2.0  # the splines reach beyond both ends, where exposures and row times do
_SINES = 5


@dataclass(frozen=True, slots=True)
class Style:
    """How a camera is carried.

    pace: times the route's speed. swing_deg (yaw, pitch) and swing_s (shortest, longest period): slow turns of the gaze, amplitude. sway_m (sideways, up):
    slow displacements, amplitude, where the route has room. shake_deg, shake_m, shake_hz (lowest, highest): tremor, standard deviation an axis.
    """

    pace: float
    swing_deg: tuple[float, float]
    swing_s: tuple[float, float]
    sway_m: tuple[float, float]
    shake_deg: float
    shake_m: float
    shake_hz: tuple[float, float]


STYLES: dict[StyleName, Style] = {
    "robust": Style(1.0, (10.0, 5.0), (5.0, 9.0), (0.15, 0.06), 0.15, 0.003, (0.5, 2.0)),
    "unstable": Style(1.3, (14.0, 8.0), (3.0, 6.0), (0.2, 0.1), 0.9, 0.012, (0.8, 3.0)),
    "aggressive": Style(2.2, (32.0, 12.0), (1.8, 3.0), (0.35, 0.2), 0.4, 0.008, (0.8, 3.0)),
}
"""Turn rates (95 % of the time below): robust 25, unstable 60, aggressive 130 degrees a second."""


class HandHeldPath:
    """Poses `world_from_camera` at any time from 0 to `duration_s`."""

    def __init__(self, route: Route, style: Style, duration_s: float, seed: int) -> None:
        rng = np.random.default_rng([seed, 77])
        way = Way(route)
        self.duration_s = duration_s
        self.lap_s = way.length_m / (route.speed_m_s * style.pace)
        times = np.arange(-_MARGIN_S, duration_s + _MARGIN_S + _KNOT_S, _KNOT_S)
        hold = min(1.0, max(route.room_m - 0.3, 0.0) / style.sway_m[0])
        position, forward = _walk(way, route, style, times, hold, rng)
        yaw = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0])) + np.deg2rad(style.swing_deg[0]) * _slow(times, style, rng)
        pitch = np.arcsin(np.clip(forward[:, 2], -1, 1)) + np.deg2rad(style.swing_deg[1]) * _slow(times, style, rng)
        roll = np.deg2rad(0.4 * style.swing_deg[1]) * _slow(times, style, rng)
        self._base = CubicSpline(times, np.c_[position, yaw, pitch, roll])
        self._tremor = _Tremor.random(style, rng)

    def poses(self, times_s: ArrayLike) -> FloatArray:
        """`world_from_camera` (N, 4, 4) at times (N,) seconds."""
        t = np.atleast_1d(np.asarray(times_s, dtype=np.float64))
        values = self._base(t) + self._tremor.at(t)
        out = np.tile(np.eye(4), (len(t), 1, 1))
        out[:, :3, :3] = upright_rotations(values[:, 3], values[:, 4], values[:, 5])
        out[:, :3, 3] = values[:, :3]
        return out

    def pose(self, t_s: float) -> FloatArray:
        """`world_from_camera` (4, 4) at one time."""
        return np.asarray(self.poses(t_s)[0])


@dataclass(frozen=True, slots=True, eq=False)
class _Tremor:
    """Sums of sines: amplitude, rate (rad/s) and phase (6, S), for x, y, z, yaw, pitch, roll."""

    amplitude: FloatArray
    rate: FloatArray
    phase: FloatArray

    @classmethod
    def random(cls, style: Style, rng: np.random.Generator) -> _Tremor:
        rate = 2 * np.pi * rng.uniform(*style.shake_hz, (6, _SINES))
        amplitude = rng.uniform(0.5, 1.0, (6, _SINES))
        amplitude *= np.sqrt(2) / np.linalg.norm(amplitude, axis=1, keepdims=True)  # unit standard deviation a row
        amplitude[:3] *= style.shake_m
        amplitude[3:] *= np.deg2rad(style.shake_deg)
        return cls(amplitude, rate, rng.uniform(0, 2 * np.pi, (6, _SINES)))

    def at(self, t: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("ds,nds->nd", self.amplitude, np.sin(t[:, None, None] * self.rate + self.phase)))


def upright_rotations(yaw: FloatArray, pitch: FloatArray, roll: FloatArray) -> FloatArray:
    """Rotations (N, 3, 3) of cameras (x right, y down, z forward) in a world with z up: yaw from x to y, pitch up, roll about the optical axis (rad)."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    forward = np.stack([cp * cy, cp * sy, sp], axis=1)
    right = np.stack([sy, -cy, np.zeros_like(yaw)], axis=1)
    down = np.cross(forward, right)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    return np.stack([c * right + s * down, c * down - s * right, forward], axis=2)


def _walk(way: Way, route: Route, style: Style, times: FloatArray, hold: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Positions (N, 3) along the route, with sway, and unit gaze (N, 3) before any swing."""
    speed = route.speed_m_s * style.pace
    start = rng.uniform(0, way.length_m)
    arc = start + speed * (times + 0.5 * _slow(times, style, rng) * hold)
    feet = way.at(arc)
    tangent = way.at(arc + 0.2) - way.at(arc - 0.2)
    side = np.cross([0.0, 0.0, 1.0], tangent / np.linalg.norm(tangent, axis=1, keepdims=True))
    position = feet + hold * (style.sway_m[0] * _slow(times, style, rng)[:, None] * side + style.sway_m[1] * _slow(times, style, rng)[:, None] * np.array([0, 0, 1.0]))
    aim = np.asarray(route.target) if route.gaze == "across" else way.at(arc + route.look_ahead_m)
    gaze = aim - (position if route.gaze == "across" else feet)
    return position, gaze / np.linalg.norm(gaze, axis=1, keepdims=True)


def _slow(times: FloatArray, style: Style, rng: np.random.Generator) -> FloatArray:
    """A smooth function (N,) within -1..1: two sines with periods between the style's."""
    periods, phases = rng.uniform(*style.swing_s, 2), rng.uniform(0, 2 * np.pi, 2)
    return np.asarray(0.6 * np.sin(2 * np.pi * times / periods[0] + phases[0]) + 0.4 * np.sin(2 * np.pi * times / periods[1] + phases[1]))
