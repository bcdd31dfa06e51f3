"""How far a trajectory is from the truth: association by time, Sim(3) alignment, absolute trajectory error.

ATE as Sturm et al. 2012 (RGB-D benchmark), alignment as Umeyama 1991. A monocular trajectory has no scale of its own, so the alignment finds it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from thegra_core.geometry.alignment import umeyama
from thegra_core.messages import BoolArray, FloatArray, IntArray
from thegra_core.outputs.trajectory import Trajectory

MIN_PAIRS = 3
UNMATCHED = -1
_ARRAYS = ("alignment", "stamps_ns", "errors", "estimate_index", "groundtruth_index")


@dataclass(frozen=True, slots=True)
class Alignment:
    """groundtruth ~ scale * rotation @ estimate + translation."""

    scale: float
    rotation: FloatArray
    translation: FloatArray

    def apply(self, points: FloatArray) -> FloatArray:
        """Points (N, 3) of the estimate in the frame of the ground truth."""
        return self.scale * points @ self.rotation.T + self.translation


@dataclass(frozen=True, slots=True)
class RunPoses:
    """Positions to draw, all in one frame: estimate (N, 3), predicted while the shutter was closed (H, 3), groundtruth (G, 3) or None."""

    estimate: FloatArray
    predicted: FloatArray
    groundtruth: FloatArray | None


@dataclass(frozen=True, slots=True)
class Association:
    """Per frame (F,) the index of the pose and of the ground truth that belong to it, `UNMATCHED` where there is none."""

    stamps_ns: IntArray
    estimate: IntArray
    groundtruth: IntArray

    @property
    def both(self) -> BoolArray:
        """Frames with a pose and ground truth."""
        return (self.estimate >= 0) & (self.groundtruth >= 0)


@dataclass(frozen=True, slots=True)
class Score:
    """Errors in ground-truth units; None where there are too few pairs to tell.

    ate_rel is ate_rmse over the RMS spread of the ground truth: 1 is the worst an aligned trajectory can do. recall_1pct counts frames whose
    error is under 1 % of the path, of all frames with ground truth. stamps_ns, errors and the indices (P,) belong to the scored pairs.
    """

    frames: int
    poses: int
    pairs: int
    tracked_pct: float
    in_closure: int
    path_length: float
    ate_rmse: float | None = None
    ate_median: float | None = None
    ate_max: float | None = None
    ate_pct: float | None = None
    ate_rel: float | None = None
    recall_1pct: float = 0.0
    rot_deg: float | None = None
    scale: float | None = None
    alignment: Alignment | None = None
    stamps_ns: IntArray | None = None
    errors: FloatArray | None = None
    estimate_index: IntArray | None = None
    groundtruth_index: IntArray | None = None

    def as_dict(self) -> dict[str, float | int | None]:
        """The figures, without arrays."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _ARRAYS}


def score_trajectory(
    estimate: Trajectory,
    groundtruth: Trajectory,
    frame_stamps_ns: IntArray | None = None,
    tolerance_ns: int | None = None,
    closures_ns: Sequence[tuple[int, int]] = (),
) -> Score:
    """Score an estimate against ground truth, frame by frame.

    Args:
        frame_stamps_ns: (F,) stamps of all frames; those of the ground truth if not given. Coverage is counted over them.
        tolerance_ns: Farthest stamp that belongs to a frame; half the median frame period if not given.
        closures_ns: Shutter closures [begin, end); their frames are not scored, poses claimed in them are counted.
    """
    frames = np.sort(groundtruth.stamps_ns if frame_stamps_ns is None else np.asarray(frame_stamps_ns, np.int64))
    tolerance = half_period(frames) if tolerance_ns is None else tolerance_ns
    association = associate(estimate, groundtruth, frames, tolerance)
    closed = _inside(frames, closures_ns)
    in_closure = int(np.sum(association.estimate[closed] >= 0))
    association = Association(frames[~closed], association.estimate[~closed], association.groundtruth[~closed])
    both = association.both
    scored = len(association.stamps_ns)
    tracked_pct = round(100.0 * float(np.mean(association.estimate >= 0)), 2) if scored else 0.0
    path = path_length(groundtruth.positions)
    base = Score(frames=scored, poses=len(estimate), pairs=int(both.sum()), tracked_pct=tracked_pct, in_closure=in_closure, path_length=path)
    if base.pairs < MIN_PAIRS:
        return base
    scored_pairs = _score_pairs(estimate.poses[association.estimate[both]], groundtruth.poses[association.groundtruth[both]], base)
    with_truth = int(np.sum(association.groundtruth >= 0))
    return replace(
        scored_pairs,
        recall_1pct=round(100.0 * float(np.sum(np.asarray(scored_pairs.errors) < 0.01 * path)) / with_truth, 2),
        stamps_ns=association.stamps_ns[both],
        estimate_index=association.estimate[both],
        groundtruth_index=association.groundtruth[both],
    )


def associate(estimate: Trajectory, groundtruth: Trajectory, frame_stamps_ns: IntArray, tolerance_ns: int) -> Association:
    """For each frame the nearest pose and the nearest ground truth within the tolerance."""
    return Association(
        frame_stamps_ns, nearest(estimate.stamps_ns, frame_stamps_ns, tolerance_ns), nearest(groundtruth.stamps_ns, frame_stamps_ns, tolerance_ns)
    )


def nearest(stamps_ns: IntArray, query_ns: IntArray, tolerance_ns: int) -> IntArray:
    """Index into the sorted stamps (N,) of the one nearest to each query (Q,), the earlier at a tie; `UNMATCHED` beyond the tolerance."""
    if len(stamps_ns) == 0:
        return np.full(len(query_ns), UNMATCHED, np.int64)
    after = np.clip(np.searchsorted(stamps_ns, query_ns), 0, len(stamps_ns) - 1)
    before = np.maximum(after - 1, 0)
    index = np.where(query_ns - stamps_ns[before] <= stamps_ns[after] - query_ns, before, after)
    return np.where(np.abs(stamps_ns[index] - query_ns) <= tolerance_ns, index, UNMATCHED).astype(np.int64)


def align(source: FloatArray, target: FloatArray) -> Alignment:
    """Sim(3) that brings source (N, 3) nearest to target (N, 3); a source without extent keeps its scale."""
    if np.allclose(source, source[0], rtol=0, atol=1e-12):
        return Alignment(1.0, np.eye(3), target.mean(axis=0) - source.mean(axis=0))
    scale, rotation, translation = umeyama(source, target, with_scale=True)
    return Alignment(float(scale), rotation, translation)


def half_period(stamps_ns: IntArray) -> int:
    """Half the median frame period, less a thousandth so that the middle between two frames belongs to neither; 0 for fewer than two."""
    return int(0.4995 * float(np.median(np.diff(stamps_ns)))) if len(stamps_ns) > 1 else 0


def path_length(positions: FloatArray) -> float:
    """Length of the polyline through positions (N, 3)."""
    return float(np.sum(np.linalg.norm(np.diff(positions, axis=0), axis=1)))


def _score_pairs(poses: FloatArray, truth: FloatArray, base: Score) -> Score:
    """`base` with the errors of pairs of poses (P, 4, 4)."""
    alignment = align(poses[:, :3, 3], truth[:, :3, 3])
    errors = np.linalg.norm(alignment.apply(poses[:, :3, 3]) - truth[:, :3, 3], axis=1)
    rmse = float(np.sqrt(np.mean(errors**2)))
    spread = float(np.sqrt(np.mean(np.sum((truth[:, :3, 3] - truth[:, :3, 3].mean(axis=0)) ** 2, axis=1))))
    return replace(
        base,
        ate_rmse=rmse,
        ate_median=float(np.median(errors)),
        ate_max=float(errors.max()),
        ate_pct=100 * rmse / base.path_length if base.path_length > 0 else None,
        ate_rel=rmse / spread if spread > 0 else None,
        rot_deg=float(np.median(_rotation_errors_deg(alignment.rotation @ poses[:, :3, :3], truth[:, :3, :3]))),
        scale=alignment.scale,
        alignment=alignment,
        errors=errors,
    )


def _inside(stamps_ns: IntArray, intervals_ns: Sequence[tuple[int, int]]) -> BoolArray:
    inside = np.zeros(len(stamps_ns), bool)
    for begin, end in intervals_ns:
        inside |= (stamps_ns >= begin) & (stamps_ns < end)
    return inside


def _rotation_errors_deg(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    cosine = (np.einsum("nij,nij->n", truth, estimate) - 1) / 2
    degrees: FloatArray = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return degrees
