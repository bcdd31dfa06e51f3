"""Scores of trajectory files against ground truth: absolute and relative errors, with the frames that count stated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thegra_core.errors import InputError
from thegra_core.evaluation.fitting import LeverArm, TimeOffset, fit_lever_arm, fit_time_offset, with_lever_arm, with_offset
from thegra_core.messages import FloatArray, IntArray
from thegra_core.outputs.scoring import MAX_GAP_NS, Score, score_trajectory
from thegra_core.outputs.trajectory import NS_PER_S, Trajectory, read_tum
from thegra_core.sources.folder import parse_stamp


@dataclass(frozen=True, slots=True)
class RelativeError:
    """Error of the motion between frames `delta` pairs apart: RMSE of translation (ground-truth units) and of rotation (degrees)."""

    pairs: int
    delta: int
    trans_rmse: float
    rot_rmse_deg: float


@dataclass(frozen=True, slots=True)
class Settings:
    """How to score: closures_ns and tolerance as `score_trajectory` takes them, max_gap_s of the reference, and what of it to fit."""

    tolerance_s: float | None = None
    max_gap_s: float = MAX_GAP_NS / NS_PER_S
    fit_lever_arm: bool = False
    fit_time_offset: bool = False


@dataclass(frozen=True, slots=True)
class FileScore:
    """What `thegra score` tells; `unfitted` is the ATE without what was fitted, None where nothing was asked for."""

    absolute: Score
    relative: RelativeError | None
    time_offset: TimeOffset | None = None
    lever_arm: LeverArm | None = None
    unfitted: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Flat figures; rpe_* are None where there are too few pairs; what was asked to be fitted has its keys."""
        relative = self.relative
        fitted: dict[str, Any] = {}
        if self.time_offset is not None:
            fitted |= {"time_offset_s": self.time_offset.seconds, "time_offset_correlation": self.time_offset.correlation, "time_offset_reason": self.time_offset.reason}
        if self.lever_arm is not None:
            body = self.lever_arm.body
            fitted |= {"lever_arm": None if body is None else [float(v) for v in body], "lever_arm_reason": self.lever_arm.reason}
        if fitted:
            fitted["ate_rmse_unfitted"] = self.unfitted
        return self.absolute.as_dict() | fitted | {
            "rpe_trans_rmse": relative.trans_rmse if relative else None,
            "rpe_rot_rmse_deg": relative.rot_rmse_deg if relative else None,
        }


def score_files(trajectory: Path, groundtruth: Path, images: Path | None = None, shutter: Path | None = None, settings: Settings | None = None) -> FileScore:
    """Score a TUM trajectory.

    Args:
        trajectory: TUM file; may hold no poses at all.
        groundtruth: TUM file.
        images: List with a stamp in the first column of each line; the frames over which coverage is counted. Default: the ground truth's stamps.
        shutter: `begin end` in seconds of each shutter closure; frames inside are not scored.
        settings: Default: half the median frame period, the reference interpolated in gaps of half a second, nothing fitted.

    Raises:
        InputError: If a file cannot be read, or the ground truth has no poses.
    """
    estimate, truth = read_tum(trajectory), read_tum(groundtruth)
    if len(truth) == 0:
        raise InputError(f"{groundtruth} holds no poses; expected a TUM trajectory")
    frames = None if images is None else read_stamps(images)
    closures = () if shutter is None else read_intervals(shutter)
    return score_fitted(estimate, truth, frames, closures, settings or Settings())


def score_fitted(estimate: Trajectory, truth: Trajectory, frames: IntArray | None, closures: Sequence[tuple[int, int]], settings: Settings) -> FileScore:
    """`score_trajectory`, with the reference's clock and lever arm fitted first where that is asked for."""

    def score(reference: Trajectory) -> Score:
        tolerance = None if settings.tolerance_s is None else round(settings.tolerance_s * NS_PER_S)
        return score_trajectory(estimate, reference, frames, tolerance, closures, round(settings.max_gap_s * NS_PER_S))

    absolute = score(truth)
    unfitted = absolute.ate_rmse if settings.fit_time_offset or settings.fit_lever_arm else None
    offset, arm = None, None
    if settings.fit_time_offset:
        offset = fit_time_offset(estimate, truth)
        truth = truth if offset.seconds is None else with_offset(truth, offset.seconds)
        absolute = score(truth)
    if settings.fit_lever_arm:
        arm = fit_lever_arm(absolute, estimate)
        truth = truth if arm.body is None else with_lever_arm(truth, arm.body)
        absolute = score(truth)
    return FileScore(absolute, relative_error(absolute, estimate), offset, arm, unfitted)


def relative_error(score: Score, estimate: Trajectory, delta: int = 1) -> RelativeError | None:
    """Relative pose error over scored pairs that are `delta` apart (Sturm et al. 2012), the estimate scaled as for the absolute error.

    Returns:
        None where nothing could be aligned.
    """
    if score.alignment is None or score.estimate_index is None or score.reference is None or len(score.estimate_index) <= delta:
        return None
    estimated, truth = estimate.poses[score.estimate_index].copy(), score.reference
    estimated[:, :3, 3] *= score.alignment.scale
    error = np.linalg.inv(_motions(truth, delta)) @ _motions(estimated, delta)
    translation = np.linalg.norm(error[:, :3, 3], axis=1)
    angle = np.degrees(np.arccos(np.clip((np.trace(error[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))
    return RelativeError(len(error), delta, float(np.sqrt(np.mean(translation**2))), float(np.sqrt(np.mean(angle**2))))


def read_stamps(path: Path) -> IntArray:
    """Stamps (F,) in nanoseconds from the first column of a list of images, sorted.

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
