"""From the camera's world to the robot's frames (REP 103 and 105): arrays in, arrays out.

The core's world has the orientation of its first keyframe's optical frame. The frame `map` is where the child frame (the base, or the camera) stood
then, with x forward, y left and z up as that frame has them. A map has no metric scale unless `scale` gives it one.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry.poses import adjoint, interpolate, inverse, rotation_from_quaternion, transform

FloatArray = NDArray[np.float64]

BODY_FROM_OPTICAL: FloatArray = transform([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0])
"""x forward, y left, z up of a body that looks along the optical axis (optical: x right, y down, z forward)."""
UNKNOWN_VARIANCE = 1e4
"""Added to each variance (m^2 or rad^2) of a pose that is a prediction, so that no filter takes it for a measurement."""
_LINEAR_FIRST = [3, 4, 5, 0, 1, 2]


@dataclass(frozen=True, slots=True)
class Frames:
    """Names of the frames and where the camera sits.

    base_from_camera (4, 4): pose of the optical camera frame in the base. Without a base frame poses are those of the camera itself.
    scale: metres of one map unit.
    """

    map: str = "map"
    odom: str = ""
    base: str = ""
    camera: str = "camera"
    base_from_camera: FloatArray = field(default_factory=BODY_FROM_OPTICAL.copy)
    scale: float = 1.0

    @property
    def child(self) -> str:
        """The frame whose pose is published."""
        return self.base or self.camera

    @property
    def child_from_camera(self) -> FloatArray:
        """(4, 4); identity where the child is the optical frame itself."""
        return self.base_from_camera if self.base else np.eye(4)

    @property
    def map_from_world(self) -> FloatArray:
        """(4, 4) that takes metric points of the core's world to the map."""
        return self.base_from_camera if self.base else BODY_FROM_OPTICAL


@dataclass(frozen=True, slots=True)
class StampedPose:
    """A pose as messages say it: map_from_child (4, 4); covariance (6, 6) of x, y, z and rotations about the map's axes; twist (6,) linear then angular in
    the child frame with its covariance (6, 6). Metres where the scale is known."""

    stamp_ns: int
    map_from_child: FloatArray
    covariance: FloatArray
    twist: FloatArray
    twist_covariance: FloatArray


def map_pose(world_from_camera: FloatArray, frames: Frames) -> FloatArray:
    """map_from_child (4, 4) of a camera pose in map units."""
    metric = world_from_camera.copy()
    metric[:3, 3] *= frames.scale
    return frames.map_from_world @ metric @ inverse(frames.child_from_camera)


def map_points(points_world: FloatArray, frames: Frames) -> FloatArray:
    """Points (N, 3) of the core's world in the frame `map`."""
    return np.asarray(frames.scale * points_world @ frames.map_from_world[:3, :3].T + frames.map_from_world[:3, 3])


def stamped_pose(
    stamp_ns: int, world_from_camera: FloatArray, covariance: FloatArray | None, twist: FloatArray | None, frames: Frames, predicted: bool = False
) -> StampedPose:
    """Pose, uncertainty and velocity as messages say them.

    Args:
        stamp_ns: Of the image.
        world_from_camera: (4, 4) in map units.
        covariance: (6, 6), rotation first, of a perturbation in the camera frame; None: nothing is known of it.
        twist: (6,) angular then linear velocity in the camera frame; None: not known, which is said by its variance.
        frames: Names, extrinsics and scale.
        predicted: The pose is no measurement: its variances grow by `UNKNOWN_VARIANCE`.
    """
    map_from_child = map_pose(world_from_camera, frames)
    units = np.array([1.0, 1.0, 1.0, *[frames.scale] * 3])
    child = adjoint(frames.child_from_camera) * units[None, :]
    to_map = np.kron(np.eye(2), map_from_child[:3, :3]) @ child
    vague = UNKNOWN_VARIANCE * np.eye(6)
    spread = vague if covariance is None else (to_map @ covariance @ to_map.T)[np.ix_(_LINEAR_FIRST, _LINEAR_FIRST)]
    if predicted and covariance is not None:
        spread = spread + vague
    motion = np.zeros(6) if twist is None else (child @ twist)[_LINEAR_FIRST]
    return StampedPose(stamp_ns, map_from_child, spread, motion, vague if twist is None or predicted else 1e-2 * np.eye(6))


class PoseHistory:
    """Poses of one frame in another over time, to look up between two of them."""

    def __init__(self, span_ns: int = 10 * 10**9) -> None:
        self._span_ns = span_ns
        self._stamps: list[int] = []
        self._poses: list[FloatArray] = []

    def add(self, stamp_ns: int, parent_from_child: FloatArray) -> None:
        """Add a pose; what is `span_ns` older is forgotten. Time that goes back begins anew."""
        if self._stamps and stamp_ns <= self._stamps[-1]:
            if stamp_ns == self._stamps[-1]:
                return
            self._stamps, self._poses = [], []
        self._stamps.append(stamp_ns)
        self._poses.append(parent_from_child)
        old = bisect_left(self._stamps, stamp_ns - self._span_ns)
        del self._stamps[:old], self._poses[:old]

    def at(self, stamp_ns: int, slack_ns: int = 200_000_000) -> FloatArray | None:
        """The pose (4, 4) at a time, interpolated; outside of the history the nearest one within `slack_ns`, else None."""
        if not self._stamps:
            return None
        after = bisect_left(self._stamps, stamp_ns)
        if after in (0, len(self._stamps)):
            nearest = min(after, len(self._stamps) - 1)
            return self._poses[nearest] if abs(self._stamps[nearest] - stamp_ns) <= slack_ns else None
        begin, end = self._stamps[after - 1], self._stamps[after]
        return interpolate(self._poses[after - 1], self._poses[after], (stamp_ns - begin) / (end - begin))


def chain(parents: Mapping[str, tuple[str, FloatArray]], base: str, frame: str) -> FloatArray | None:
    """base_from_frame (4, 4) along a tree of {child: (parent, parent_from_child)}; None where no path leads up from `frame` to `base`."""
    result = np.eye(4)
    for _ in range(len(parents) + 1):
        if frame == base:
            return result
        if frame not in parents:
            return None
        frame, parent_from_child = parents[frame]
        result = parent_from_child @ result
    return None


def extrinsics(text: str) -> FloatArray:
    """(4, 4) of `x y z qx qy qz qw`, with spaces or commas between them.

    Raises:
        ValueError: If they are not seven numbers, or the quaternion is zero.
    """
    try:
        values = np.array([float(part) for part in text.replace(",", " ").split()])
    except ValueError:
        values = np.empty(0)
    if values.shape != (7,) or not np.all(np.isfinite(values)) or not np.any(values[3:]):
        raise ValueError(f"{text!r} is not x y z qx qy qz qw of the optical camera frame in the base frame")
    return transform(rotation_from_quaternion(values[3:]), values[:3])
