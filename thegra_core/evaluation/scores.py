"""Scores of trajectory files against ground truth: absolute and relative errors, with the frames that count stated."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thegra_core.errors import InputError
from thegra_core.messages import FloatArray, IntArray
from thegra_core.outputs.scoring import Score, score_trajectory
from thegra_core.outputs.trajectory import NS_PER_S, Trajectory, parse_stamp, read_tum


@dataclass(frozen=True, slots=True)
class RelativeError:
    """Error of the motion between frames `delta` pairs apart: RMSE of translation (ground-truth units) and of rotation (degrees)."""

    pairs: int
    delta: int
    trans_rmse: float
    rot_rmse_deg: float


@dataclass(frozen=True, slots=True)
class FileScore:
    """What `thegra score` tells."""

    absolute: Score
    relative: RelativeError | None

    def as_dict(self) -> dict[str, Any]:
        """Flat figures; rpe_* are None where there are too few pairs."""
        relative = self.relative
        return self.absolute.as_dict() | {
            "rpe_trans_rmse": relative.trans_rmse if relative else None,
            "rpe_rot_rmse_deg": relative.rot_rmse_deg if relative else None,
        }


def score_files(
    trajectory: Path, groundtruth: Path, images: Path | None = None, shutter: Path | None = None, tolerance_s: float | None = None
) -> FileScore:
    """Score a TUM trajectory.

    Args:
        trajectory: TUM file; may hold no poses at all.
        groundtruth: TUM file.
        images: List with a stamp in the first column of each line; the frames over which coverage is counted. Default: the ground truth's stamps.
        shutter: `begin end` in seconds of each shutter closure; frames inside are not scored.
        tolerance_s: Farthest stamp that belongs to a frame; default half the median frame period.

    Raises:
        InputError: If a file cannot be read, or the ground truth has no poses.
    """
    estimate, truth = read_tum(trajectory), read_tum(groundtruth)
    if len(truth) == 0:
        raise InputError(f"{groundtruth} holds no poses; expected a TUM trajectory")
    frames = None if images is None else read_stamps(images)
    closures = () if shutter is None else read_intervals(shutter)
    tolerance = None if tolerance_s is None else round(tolerance_s * NS_PER_S)
    score = score_trajectory(estimate, truth, frames, tolerance, closures)
    return FileScore(score, relative_error(score, estimate, truth))


def relative_error(score: Score, estimate: Trajectory, groundtruth: Trajectory, delta: int = 1) -> RelativeError | None:
    """Relative pose error over scored pairs that are `delta` apart (Sturm et al. 2012), the estimate scaled as for the absolute error.

    Returns:
        None where nothing could be aligned.
    """
    if score.alignment is None or score.estimate_index is None or score.groundtruth_index is None or len(score.estimate_index) <= delta:
        return None
    estimated, truth = estimate.poses[score.estimate_index].copy(), groundtruth.poses[score.groundtruth_index]
    estimated[:, :3, 3] *= score.alignment.scale
    error = np.linalg.inv(_motions(truth, delta)) @ _motions(estimated, delta)
    translation = np.linalg.norm(error[:, :3, 3], axis=1)
    angle = np.degrees(np.arccos(np.clip((np.trace(error[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))
    return RelativeError(len(error), delta, float(np.sqrt(np.mean(translation**2))), float(np.sqrt(np.mean(angle**2))))


def read_stamps(path: Path) -> IntArray:
    """Stamps (F,) in nanoseconds from the first column of a list, sorted.

    Raises:
        InputError: Naming the line that holds none.
    """
    return np.sort(np.array([row[0] for row in _rows(path, 1, "`t path`")], np.int64))


def read_intervals(path: Path) -> tuple[tuple[int, int], ...]:
    """(begin, end) pairs in nanoseconds.

    Raises:
        InputError: Naming the line that is none.
    """
    return tuple((row[0], row[1]) for row in _rows(path, 2, "`begin end`"))


def _rows(path: Path, columns: int, form: str) -> list[list[int]]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from error
    rows: list[list[int]] = []
    for number, line in enumerate(lines, 1):
        words = line.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            rows.append([parse_stamp(words[column]) for column in range(columns)])
        except (ValueError, IndexError) as error:
            raise InputError(f"{path}:{number}: expected {form} in seconds, got {line.strip()!r}") from error
    return rows


def _motions(poses: FloatArray, delta: int) -> FloatArray:
    return np.asarray(np.linalg.inv(poses[:-delta]) @ poses[delta:])
