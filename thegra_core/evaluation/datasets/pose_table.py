"""Trajectories from tables of unknown layout (csv, TUM, KITTI): what was decided about the columns is told, since nobody else will notice a wrong guess."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from thegra_core.errors import InputError
from thegra_core.evaluation.datasets.columns import Columns, by_names, by_values
from thegra_core.messages import BoolArray, FloatArray, IntArray
from thegra_core.outputs.trajectory import Trajectory

_UNITS = (("ns", 1, 1e17), ("us", 10**3, 1e14), ("ms", 10**6, 1e11), ("s", 10**9, -np.inf))
"""Name, nanoseconds, and the least median of times since 1970 that is in it."""
_RELATIVE_S = 1e8


@dataclass(frozen=True, slots=True)
class PoseTable:
    """A trajectory and the decisions it rests on, as one sentence."""

    trajectory: Trajectory
    decision: str


def read_pose_table(path: Path, stamps_ns: IntArray | None = None) -> PoseTable:
    """Poses of a text table.

    Args:
        path: Columns between commas, semicolons or blanks, with or without a header; lines of `#` or `%` are comments, the last of them the header.
        stamps_ns: (N,) stamps of its rows, for tables without time.

    Raises:
        InputError: If it cannot be read, or no position (and time) can be made out.
    """
    names, cells, left_out = _read(path)
    values = np.array([[_number(cell) for cell in row] for row in cells])
    columns = (by_names(names) if len(names) == values.shape[1] else None) or by_values(values, timed=stamps_ns is None)
    if columns is None or (columns.time is None and stamps_ns is None):
        raise InputError(f"{path}: no columns of time and position can be made out in {len(cells[0])} columns; give `t x y z qx qy qz qw`, or a header that names them")
    if stamps_ns is None:
        stamps, unit = _stamps(cells, values, columns, names)
        when = f"time in column {columns.time} ({unit})"
    else:
        if len(stamps_ns) != len(cells):
            raise InputError(f"{path} holds {len(cells)} poses but there are {len(stamps_ns)} stamps for them")
        stamps, when = stamps_ns, "time from its own list"
    poses, finite = _poses(values, columns)
    trajectory = _sorted_once(stamps[finite], poses[finite])
    if len(trajectory) == 0:
        raise InputError(f"{path} holds no pose whose numbers are finite")
    skipped = left_out + int(np.sum(~finite)) + int(finite.sum()) - len(trajectory)
    rest = f"; {skipped} rows left out (not numbers, or a stamp twice)" if skipped else ""
    return PoseTable(trajectory, f"{path.name}: {when}, position in {list(columns.position)}, {_orientation(columns)}, {columns.why}{rest}")


def _read(path: Path) -> tuple[list[str], list[list[str]], int]:
    """Names of the header (none: empty), rows of cells of equal length, and the number of rows left out."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from error
    rows = [line.strip() for line in lines if line.strip()]
    first = next((i for i, row in enumerate(rows) if row[0] not in "#%" and _numeric(_split(row)) >= 3), None)
    if first is None:
        raise InputError(f"{path} holds no row of numbers")
    cells = [_split(row) for row in rows[first:] if row[0] not in "#%"]
    width = len(cells[0])
    whole = [row for row in cells if len(row) == width]
    header = _split(rows[first - 1].lstrip("#% ")) if first > 0 else []
    return header, whole, len(cells) - len(whole)


def _split(row: str) -> list[str]:
    for mark in (",", ";", "\t"):
        if mark in row:
            return [cell.strip() for cell in row.rstrip(mark).split(mark)]
    return row.split()


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def _numeric(cells: Sequence[str]) -> int:
    return int(np.sum(~np.isnan([_number(cell) for cell in cells])))


def _stamps(cells: list[list[str]], values: FloatArray, columns: Columns, names: list[str]) -> tuple[IntArray, str]:
    """Stamps (N,) in ns, exact, and the unit that was found."""
    time = columns.time
    assert time is not None
    median = float(np.median(values[:, time]))
    unit, factor = next((name, factor) for name, factor, least in _UNITS if median >= least)
    named_ns = bool(names) and len(names) > time and "[ns]" in names[time].replace(" ", "").lower()
    if named_ns:
        unit, factor = "ns", 1
    stamps = np.array([_exact(row[time], factor) for row in cells], np.int64)
    if columns.time_ns is not None:
        stamps = stamps + np.array([_exact(row[columns.time_ns], 1) for row in cells], np.int64)
        unit = "s and ns"
    relative = ", counted from its own beginning" if median * factor * 1e-9 < _RELATIVE_S else ""
    return stamps, f"{unit}{' by the header' if named_ns else ' by magnitude'}{relative}"


def _exact(text: str, factor: int) -> int:
    try:
        return int((Decimal(text) * factor).to_integral_value())
    except (InvalidOperation, ValueError, OverflowError):
        return 0


def _poses(values: FloatArray, columns: Columns) -> tuple[FloatArray, BoolArray]:
    """Poses (N, 4, 4), and which of them have finite numbers."""
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    used = [*columns.position, *columns.quaternion, *columns.euler]
    used += list(range(columns.matrix, columns.matrix + 12)) if columns.matrix is not None else []
    finite: BoolArray = np.asarray(np.isfinite(values[:, used]).all(axis=1), bool)
    if columns.quaternion:
        finite = finite & (np.linalg.norm(values[:, columns.quaternion], axis=1) > 0.5)
        poses[finite, :3, :3] = Rotation.from_quat(values[finite][:, columns.quaternion]).as_matrix()
    elif columns.euler:
        angles = values[finite][:, columns.euler]
        poses[finite, :3, :3] = Rotation.from_euler("xyz", angles, degrees=bool(np.abs(angles).max(initial=0) > 2 * np.pi)).as_matrix()
    elif columns.matrix is not None:
        rotations = values[finite][:, columns.matrix : columns.matrix + 12].reshape(-1, 3, 4)[:, :, :3]
        poses[finite, :3, :3] = Rotation.from_matrix(rotations).as_matrix()
    poses[:, :3, 3] = values[:, columns.position]
    return poses, finite


def _sorted_once(stamps: IntArray, poses: FloatArray) -> Trajectory:
    unique, index = np.unique(stamps, return_index=True)
    return Trajectory(unique, poses[index])


def _orientation(columns: Columns) -> str:
    if columns.quaternion:
        return f"quaternion x y z w in {list(columns.quaternion)}"
    if columns.euler:
        return f"roll, pitch, yaw in {list(columns.euler)}"
    return "a matrix" if columns.matrix is not None else "no orientation"
