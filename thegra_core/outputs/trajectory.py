"""Trajectories as TUM text files: `t tx ty tz qx qy qz qw` a line, poses `world_from_camera`.

Stamps are written and read as decimal text, never through a float: a double holds a Unix time only to about 200 ns.
Format: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from thegra_core.errors import InputError
from thegra_core.geometry.poses import quaternion_from_rotation, rotation_from_quaternion
from thegra_core.messages import FloatArray, IntArray, Run

NS_PER_S = 1_000_000_000
_COLUMNS = 8
_DECIMALS = 9
_EXPECTED = "expected `t tx ty tz qx qy qz qw` (seconds, position, quaternion xyzw)"


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses over time: stamps_ns (N,) int64 in non-decreasing order, poses (N, 4, 4) float64 `world_from_camera`."""

    stamps_ns: IntArray
    poses: FloatArray

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions(self) -> FloatArray:
        """Camera centres in the world, (N, 3)."""
        return self.poses[:, :3, 3]


def make_trajectory(stamped_poses: Iterable[tuple[int, FloatArray]]) -> Trajectory:
    """Trajectory of (stamp_ns, world_from_camera) pairs, sorted by time; pairs of equal stamp keep their order."""
    pairs = sorted(stamped_poses, key=lambda pair: pair[0])
    stamps = np.array([stamp for stamp, _ in pairs], dtype=np.int64)
    poses = np.array([pose for _, pose in pairs], dtype=np.float64).reshape(-1, 4, 4)
    return Trajectory(stamps, poses)


def final_trajectory(run: Run, map_id: int) -> Trajectory:
    """Frames of one map, each with the pose that the finished map gives it."""
    return make_trajectory((f.stamp_ns, f.world_from_camera) for f in run.frames if f.map_id == map_id and f.world_from_camera is not None)


def live_trajectory(run: Run, map_id: int) -> Trajectory:
    """Frames of one map as they were estimated at the time (causal); what was localised afterwards is not among them."""
    return make_trajectory((f.stamp_ns, f.world_from_camera_live) for f in run.frames if f.map_id == f.result.map_id == map_id and f.world_from_camera_live is not None)


def predicted_trajectory(run: Run, map_id: int) -> Trajectory:
    """Poses predicted while the shutter was closed and one map was tracked; as predicted at the time."""
    return make_trajectory((f.stamp_ns, f.predicted) for f in run.frames if f.result.map_id == map_id and f.predicted is not None)


def keyframe_trajectory(run: Run, map_id: int) -> Trajectory:
    """Keyframes of one finished map; empty if there is no such map."""
    summary = next((m for m in run.maps if m.map_id == map_id), None)
    if summary is None:
        return make_trajectory(())
    return make_trajectory(zip(summary.keyframe_stamps_ns.tolist(), summary.keyframe_poses, strict=True))


def format_tum(trajectory: Trajectory) -> str:
    """TUM text; quaternions have unit norm and the sign that makes w positive (or the first of x, y, z that is not 0)."""
    rows = zip(trajectory.stamps_ns.tolist(), trajectory.poses, strict=True)
    return "".join(f"{format_stamp(stamp)} {_numbers(pose[:3, 3])} {_numbers(_canonical_quaternion(pose[:3, :3]))}\n" for stamp, pose in rows)


def read_tum(path: Path) -> Trajectory:
    """Trajectory from a TUM file: whitespace or commas between columns, `#` starts a comment, any order in time.

    Raises:
        InputError: Naming the file and line that is not a pose, or the file if it cannot be read or holds none.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot read the trajectory {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text file: {_EXPECTED} a line") from error
    rows = [_parse_line(line, f"{path}:{number}") for number, line in enumerate(text.splitlines(), 1) if line.split("#")[0].strip()]
    return make_trajectory(rows)


def format_stamp(stamp_ns: int) -> str:
    """Nanoseconds as seconds with 9 decimals, exactly."""
    sign = "-" if stamp_ns < 0 else ""
    seconds, rest = divmod(abs(stamp_ns), NS_PER_S)
    return f"{sign}{seconds}.{rest:09d}"


def parse_stamp(text: str) -> int:
    """Decimal seconds to nanoseconds, rounded to the nearest.

    Raises:
        ValueError: If the text is no finite number, or no time that 64 bits of nanoseconds can hold.
    """
    try:
        stamp = int((Decimal(text) * NS_PER_S).to_integral_value())
    except (InvalidOperation, ValueError, OverflowError) as error:
        raise ValueError(f"{text!r} is no time in seconds") from error
    if abs(stamp) >= 2**63:
        raise ValueError(f"{text!r} is out of range for a time in seconds")
    return stamp


def _parse_line(line: str, where: str) -> tuple[int, FloatArray]:
    columns = line.split("#")[0].replace(",", " ").split()
    if len(columns) < _COLUMNS:
        raise InputError(f"{where}: {len(columns)} columns; {_EXPECTED}")
    try:
        stamp = parse_stamp(columns[0])
        values = np.array([float(column) for column in columns[1:_COLUMNS]])
    except ValueError as error:
        raise InputError(f"{where}: {error}; {_EXPECTED}") from error
    if not np.all(np.isfinite(values)):
        raise InputError(f"{where}: a value is not finite; {_EXPECTED}")
    if np.linalg.norm(values[3:]) < 1e-6:
        raise InputError(f"{where}: the quaternion is zero; {_EXPECTED}")
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_quaternion(values[3:])
    pose[:3, 3] = values[:3]
    return stamp, pose


def _canonical_quaternion(rotation: FloatArray) -> FloatArray:
    quaternion = np.round(quaternion_from_rotation(rotation), _DECIMALS)
    leading = next((value for value in quaternion[[3, 0, 1, 2]] if value != 0), 1.0)
    return np.asarray(-quaternion if leading < 0 else quaternion)


def _numbers(values: FloatArray) -> str:
    return " ".join(f"{value + 0.0:.{_DECIMALS}f}" for value in values)
