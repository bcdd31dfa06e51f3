"""Which columns of a table of poses are which: by their names, else by what the numbers look like."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thegra_core.messages import FloatArray

UNIT_TOLERANCE = 0.02
_QUATERNION = {"q", "quat", "quaternion", "orientation", "rotation", "rot", "ori", "attitude"}
_NOT_POSE = {"twist", "linear", "angular", "covariance", "velocity", "vel", "acc", "acceleration", "v", "bw", "ba", "gyro", "bias", "b"}
_TIME = {"t", "time", "timestamp", "timestamps", "stamp", "sec", "secs", "seconds", "nsec", "nsecs", "nanosec", "ns", "times"}
_NANOSECONDS = {"nsec", "nsecs", "nanosec", "nanoseconds"}
_EULER = ("roll", "pitch", "yaw")
_SMALL = 0.2
_GROWING = 0.8
_SINCE_1970_S = 1e8


@dataclass(frozen=True, slots=True)
class Columns:
    """Indices: time (and time_ns, where nanoseconds have their own column), position x y z, then quaternion in the order x y z w, or euler
    (roll, pitch, yaw), or matrix (first of 12 columns of a 3x4), or none of them. `why` says how they were told."""

    time: int | None
    position: tuple[int, ...]
    quaternion: tuple[int, ...] = ()
    euler: tuple[int, ...] = ()
    matrix: int | None = None
    time_ns: int | None = None
    why: str = ""


def by_names(names: Sequence[str]) -> Columns | None:
    """Columns by their header; None where it does not name time and position."""
    tokens = [re.findall(r"[a-z]+", re.sub(r"\[.*?\]|\(.*?\)", "", name.lower())) for name in names]
    usable = [(i, t) for i, t in enumerate(tokens) if t and not set(t) & _NOT_POSE]
    quaternion, position = {}, {}  # type: dict[str, int], dict[str, int]
    for i, words in usable:
        axis = words[-1][-1]
        if axis not in "xyzw" or len(words[-1]) > 4:
            continue
        if set(words) & _QUATERNION or words[-1][0] == "q" or axis == "w":
            quaternion.setdefault(axis, i)
        else:
            position.setdefault(axis, i)
    times = [i for i, words in usable if words[-1] in _TIME and not set(words) & _NANOSECONDS]
    nanoseconds = [i for i, words in usable if set(words) & _NANOSECONDS]
    euler = [next((i for i, words in usable if words[-1] == name), -1) for name in _EULER]
    if not times or len(position) < 3:
        return None
    time = max(times, key=lambda i: "header" in tokens[i] or "stamp" in tokens[i])
    pair = nanoseconds[0] if nanoseconds and tokens[time][-1] in ("sec", "secs") else None
    return Columns(
        time=time,
        position=tuple(position[a] for a in "xyz"),
        quaternion=tuple(quaternion[a] for a in "xyzw") if len(quaternion) == 4 else (),
        euler=tuple(euler) if min(euler) >= 0 and len(quaternion) < 4 else (),
        time_ns=pair,
        why="by the header",
    )


def by_values(values: FloatArray, timed: bool = True) -> Columns | None:
    """Columns (N, C) by their numbers: time grows (unless the table has none), a rotation matrix is orthonormal, a quaternion has norm 1, the position stands beside it."""
    count = values.shape[1]
    time = _time_column(values) if timed else None
    for first in range(count - 11):
        if time not in range(first, first + 12) and _is_rotation(values[:, [first, first + 1, first + 2, first + 4, first + 5, first + 6, first + 8, first + 9, first + 10]]):
            return Columns(time, (first + 3, first + 7, first + 11), matrix=first, why=f"3x4 matrix in columns {first} to {first + 11}")
    block = _unit_block(values, time)
    if block is not None:
        before, after = tuple(range(block - 3, block)), tuple(range(block + 4, block + 7))
        follows = before[0] >= 0 and time not in before
        if not follows and (after[-1] >= count or time in after):
            return None
        order, why = quaternion_order(values[:, block : block + 4], follows)
        return Columns(time, before if follows else after, tuple(block + "xyzw".index(a) if order == "xyzw" else block + "wxyz".index(a) for a in "xyzw"), why=why)
    rest = [i for i in range(count) if i != time and not np.isnan(values[:, i]).any()]
    if (time is None and timed) or len(rest) < 3:
        return None
    first = next((i for i in rest if time is None or i > time), rest[0])
    position = tuple(rest[rest.index(first) : rest.index(first) + 3])
    return Columns(time, position, why="the three columns after the time; no orientation found") if len(position) == 3 else None


def quaternion_order(block: FloatArray, follows_position: bool) -> tuple[str, str]:
    """`xyzw` or `wxyz` of unit quaternions (N, 4), and why.

    A tracked body that stays upright has small x and y, so the two small neighbours tell the order. Rotation angles between poses do not depend on
    the order and cannot tell it; where nothing does, the custom is xyzw after the position and wxyz before it.
    """
    size = np.sqrt(np.mean(block**2, axis=0))
    if size[:2].max() < _SMALL <= size[1:3].max():
        return "xyzw", "quaternion x y z w: the body stays upright"
    if size[1:3].max() < _SMALL <= size[:2].max():
        if size[3] < _SMALL and size[0] > 1 - _SMALL:
            return "wxyz", "quaternion w x y z: the body hardly turns"
        return "wxyz", "quaternion w x y z: the body stays upright"
    if size[:3].max() < _SMALL:
        return "xyzw", "quaternion x y z w: the body hardly turns"
    order = "xyzw" if follows_position else "wxyz"
    return order, f"quaternion {' '.join(order)} assumed: nothing in the numbers tells; it matters for lever arms and rotation errors only"


def _time_column(values: FloatArray) -> int | None:
    """A column that grows nearly always: one of times since 1970 if there is any, else the first."""
    steps = np.diff(values, axis=0)
    growing = [i for i in range(values.shape[1]) if len(steps) and np.mean(steps[:, i] >= 0) >= _GROWING and np.nanmax(values[:, i]) > np.nanmin(values[:, i])]
    absolute = [i for i in growing if np.nanmedian(values[:, i]) > _SINCE_1970_S]
    return next(iter(absolute or growing), None)


def _unit_block(values: FloatArray, time: int | None) -> int | None:
    deviations = {}
    for first in range(values.shape[1] - 3):
        if time is not None and first <= time < first + 4:
            continue
        norms = np.linalg.norm(values[:, first : first + 4], axis=1)
        if np.mean(np.abs(norms - 1) < UNIT_TOLERANCE) >= 0.95:
            deviations[first] = float(np.median(np.abs(norms - 1)))
    return min(deviations, key=lambda first: (round(deviations[first], 5), first)) if deviations else None


def _is_rotation(nine: FloatArray) -> bool:
    matrices = nine.reshape(-1, 3, 3)
    off = np.abs(matrices @ np.swapaxes(matrices, 1, 2) - np.eye(3)).max(axis=(1, 2))
    return bool(np.mean(off < UNIT_TOLERANCE) >= 0.95)
