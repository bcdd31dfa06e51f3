"""How far a trajectory is from the truth: association by time, Sim(3) alignment, absolute trajectory error.

ATE as Sturm et al. 2012 (RGB-D benchmark), alignment as Umeyama 1991. A monocular trajectory has no scale of its own, so the alignment finds it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial.transform import Rotation

from thegra_core.geometry.alignment import umeyama
from thegra_core.messages import BoolArray, FloatArray, IntArray
from thegra_core.outputs.trajectory import Trajectory

MIN_PAIRS = 3
UNMATCHED = -1
MIN_COVERAGE_PCT = 50.0
"""Frames with a pose below which an error is not quoted: it would be that of the part that was easy."""
MAX_GAP_NS = 500_000_000
"""Longest gap between two poses of the reference inside which it is interpolated."""
_ARRAYS = ("alignment", "stamps_ns", "errors", "estimate_index", "reference")


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
    """Per frame (F,) the index of the pose that belongs to it (`UNMATCHED`: none), the reference (F, 4, 4) then, and whether it is known."""

    stamps_ns: IntArray
    estimate: IntArray
    reference: FloatArray
    known: BoolArray

    @property
    def both(self) -> BoolArray:
        """Frames with a pose and ground truth."""
        return (self.estimate >= 0) & self.known

    def only(self, frames: BoolArray) -> Association:
        """Some of the frames."""
        return Association(self.stamps_ns[frames], self.estimate[frames], self.reference[frames], self.known[frames])


@dataclass(frozen=True, slots=True)
class Score:
    """Errors in ground-truth units; None where there are too few pairs to tell.

    pairs are frames with a pose and ground truth, pairs_pct their share of all frames, time_pct the time from the first to the last of them, of
    the time that the frames span. path_length is that of the whole reference; path_scored and spread (RMS distance from the centroid) are of its
    scored part. ate_rel is ate_rmse over spread: 1 is the worst an aligned trajectory can do. recall_1pct counts frames whose error is under 1 % of
    path_length, of all frames with ground truth. stamps_ns, errors, estimate_index (P,) and reference (P, 4, 4) belong to the pairs.
    """

    frames: int
    poses: int
    pairs: int
    tracked_pct: float
    in_closure: int
    path_length: float
    pairs_pct: float = 0.0
    time_pct: float = 0.0
    path_scored: float = 0.0
    spread: float | None = None
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
    reference: FloatArray | None = None

    @property
    def covered(self) -> bool:
        """Whether enough frames have a pose for the error to be quoted."""
        return self.tracked_pct >= MIN_COVERAGE_PCT

    def as_dict(self) -> dict[str, float | int | None]:
        """The figures, without arrays; `covered` says whether the errors may be quoted."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _ARRAYS} | {"covered": self.covered}


def score_trajectory(
    estimate: Trajectory,
    groundtruth: Trajectory,
    frame_stamps_ns: IntArray | None = None,
    tolerance_ns: int | None = None,
    closures_ns: Sequence[tuple[int, int]] = (),
    max_gap_ns: int = MAX_GAP_NS,
    path: float | None = None,
) -> Score:
    """Score an estimate against ground truth, frame by frame.

    Args:
        frame_stamps_ns: (F,) stamps of all frames; those of the ground truth if not given. Coverage is counted over them.
        tolerance_ns: Farthest stamp that belongs to a frame; half the median frame period if not given.
        closures_ns: Shutter closures [begin, end); their frames are not scored, poses claimed in them are counted.
        max_gap_ns: Gaps of the ground truth up to this are interpolated, at the frame's stamp (at the pose's where the frames are those of the
            ground truth); elsewhere, and everywhere if it is 0, its nearest pose within the tolerance counts.
        path: Length of the path; that of the ground truth if not given.
    """
    frames = np.sort(groundtruth.stamps_ns if frame_stamps_ns is None else np.asarray(frame_stamps_ns, np.int64))
    tolerance = half_period(frames) if tolerance_ns is None else tolerance_ns
    association = associate(estimate, groundtruth, frames, tolerance, max_gap_ns, at_poses=frame_stamps_ns is None)
    closed = _inside(frames, closures_ns)
    in_closure = int(np.sum(association.estimate[closed] >= 0))
    association = association.only(~closed)
    path = path_length(groundtruth.positions) if path is None else path
    base = replace(_coverage(association, path), poses=len(estimate), in_closure=in_closure)
    if base.pairs < MIN_PAIRS:
        return base
    both = association.both
    scored = _score_pairs(estimate.poses[association.estimate[both]], association.reference[both], base)
    recalled = np.sum(np.asarray(scored.errors) < 0.01 * path) / np.sum(association.known)
    return replace(
        scored,
        recall_1pct=round(100.0 * float(recalled), 2),
        stamps_ns=association.stamps_ns[both],
        estimate_index=association.estimate[both],
        reference=association.reference[both],
    )


def associate(
    estimate: Trajectory, groundtruth: Trajectory, frame_stamps_ns: IntArray, tolerance_ns: int, max_gap_ns: int = MAX_GAP_NS, at_poses: bool = False
) -> Association:
    """For each frame the nearest pose within the tolerance, and the ground truth at the frame's stamp, or at the pose's where there is one."""
    index = nearest(estimate.stamps_ns, frame_stamps_ns, tolerance_ns)
    stamps = frame_stamps_ns.copy()
    if at_poses:
        stamps[index >= 0] = estimate.stamps_ns[index[index >= 0]]
    reference, known = reference_at(groundtruth, stamps, nearest(groundtruth.stamps_ns, frame_stamps_ns, tolerance_ns), max_gap_ns)
    return Association(frame_stamps_ns, index, reference, known)


def reference_at(groundtruth: Trajectory, stamps_ns: IntArray, otherwise: IntArray, max_gap_ns: int) -> tuple[FloatArray, BoolArray]:
    """Ground truth (N, 4, 4) at stamps (N,), and where it is known.

    Interpolated on SE(3) between two poses no farther apart than `max_gap_ns`; elsewhere the pose of index `otherwise` (`UNMATCHED`: unknown).
    """
    known = otherwise >= 0
    poses = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
    if len(groundtruth):
        poses[known] = groundtruth.poses[otherwise[known]]
    if len(groundtruth) < 2 or max_gap_ns <= 0:
        return poses, known
    times = groundtruth.stamps_ns
    right = np.clip(np.searchsorted(times, stamps_ns), 1, len(times) - 1)
    step, since = times[right] - times[right - 1], stamps_ns - times[right - 1]
    between = (since >= 0) & (since <= step) & (step > 0) & (step <= max_gap_ns)
    first, second = groundtruth.poses[right[between] - 1], groundtruth.poses[right[between]]
    poses[between] = _interpolate(first, second, since[between] / step[between])
    return poses, known | between


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


def within(trajectory: Trajectory, stamps_ns: IntArray) -> Trajectory:
    """The part of a trajectory in the time that frames (F,) span, half a period around it; all of it for no frames."""
    if len(stamps_ns) == 0:
        return trajectory
    margin = half_period(stamps_ns)
    inside = (trajectory.stamps_ns >= stamps_ns[0] - margin) & (trajectory.stamps_ns <= stamps_ns[-1] + margin)
    return Trajectory(trajectory.stamps_ns[inside], trajectory.poses[inside])


def spread_of(positions: FloatArray) -> float:
    """RMS distance of positions (N, 3) from their centroid: an aligned trajectory cannot have a larger ATE."""
    return float(np.sqrt(np.mean(np.sum((positions - positions.mean(axis=0)) ** 2, axis=1)))) if len(positions) else 0.0


def _coverage(association: Association, path: float) -> Score:
    """What can be told without alignment."""
    both, frames = association.both, len(association.stamps_ns)
    stamps, positions = association.stamps_ns[both], association.reference[both][:, :3, 3]
    whole_ns = int(association.stamps_ns[-1] - association.stamps_ns[0]) if frames else 0
    return Score(
        frames=frames,
        poses=0,
        pairs=int(both.sum()),
        tracked_pct=round(100.0 * float(np.mean(association.estimate >= 0)), 2) if frames else 0.0,
        in_closure=0,
        path_length=path,
        pairs_pct=round(100.0 * float(np.mean(both)), 2) if frames else 0.0,
        time_pct=round(100.0 * float(stamps[-1] - stamps[0]) / whole_ns, 2) if len(stamps) and whole_ns else 0.0,
        path_scored=path_length(positions),
        spread=spread_of(positions) if len(positions) else None,
    )


def _interpolate(first: FloatArray, second: FloatArray, fraction: FloatArray) -> FloatArray:
    """Poses (N, 4, 4) a fraction (N,) of the way from the first to the second."""
    poses = np.tile(np.eye(4), (len(first), 1, 1))
    if len(first) == 0:
        return poses
    begin, weight = Rotation.from_matrix(first[:, :3, :3]), fraction[:, None]
    turn = (begin.inv() * Rotation.from_matrix(second[:, :3, :3])).as_rotvec()
    poses[:, :3, :3] = (begin * Rotation.from_rotvec(weight * turn)).as_matrix()
    poses[:, :3, 3] = (1 - weight) * first[:, :3, 3] + weight * second[:, :3, 3]
    return poses


def _score_pairs(poses: FloatArray, truth: FloatArray, base: Score) -> Score:
    """`base` with the errors of pairs of poses (P, 4, 4)."""
    alignment = align(poses[:, :3, 3], truth[:, :3, 3])
    errors = np.linalg.norm(alignment.apply(poses[:, :3, 3]) - truth[:, :3, 3], axis=1)
    rmse, spread = float(np.sqrt(np.mean(errors**2))), spread_of(truth[:, :3, 3])
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
