"""What a reference may lack, fitted only when asked: the camera's place on the tracked body, and the offset of its clock."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from thegra_core.messages import BoolArray, FloatArray, IntArray
from thegra_core.outputs.scoring import MAX_GAP_NS, UNMATCHED, Score, align, reference_at
from thegra_core.outputs.trajectory import NS_PER_S, Trajectory

MAX_OFFSET_S = 0.5
MIN_CORRELATION = 0.6
MIN_TURN_DEG = 10.0
"""RMS rotation about the mean orientation below which a lever arm would only soak up other errors."""
_BASELINE_NS = 200_000_000
"""Time over which rotation rates are taken: short of a hand's motion, long enough that an estimate's noise does not drown it."""
_STEPS_S = (0.025, 0.005, 0.001)
_MIN_RATES = 20
_STILL_RAD_S = 0.02
_RIDGE = 1e-6


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """seconds to add to the reference's stamps to have the images' clock, and the correlation of both rotation rates there; None: not told, see `reason`."""

    seconds: float | None
    correlation: float = 0.0
    reason: str = ""


@dataclass(frozen=True, slots=True)
class LeverArm:
    """Position (3,) of the camera in the frame of the reference's body, reference units; None: not told, see `reason`."""

    body: FloatArray | None
    reason: str = ""


def fit_time_offset(estimate: Trajectory, groundtruth: Trajectory, bound_s: float = MAX_OFFSET_S) -> TimeOffset:
    """The offset within +-`bound_s` at which the rotation rates of both agree best; these depend on no scale, frame or lever arm."""
    first, second = _rate_pairs(estimate.stamps_ns)
    if len(first) < _MIN_RATES or len(groundtruth) < 2:
        return TimeOffset(None, reason=f"needs {_MIN_RATES} pairs of poses, there are {len(first)}")
    rates = _angles(estimate.poses[first], estimate.poses[second]) / (estimate.stamps_ns[second] - estimate.stamps_ns[first])

    def correlations(offsets_s: FloatArray) -> FloatArray:
        return np.array([_correlation(rates, groundtruth, estimate.stamps_ns, first, second, round(o * NS_PER_S)) for o in offsets_s])

    grid = np.arange(-bound_s, bound_s + _STEPS_S[0] / 2, _STEPS_S[0])
    values = correlations(grid)
    for before, step in itertools.pairwise(_STEPS_S):
        grid = np.clip(grid[int(np.argmax(values))] + np.arange(-before, before + step / 2, step), -bound_s, bound_s)
        values = correlations(grid)
    best = int(np.argmax(values))
    if values[best] < MIN_CORRELATION:
        return TimeOffset(None, float(values[best]), f"the rotation rates correlate by {values[best]:.2f} at best, {MIN_CORRELATION:g} is needed: too little rotation, or another recording")
    if abs(grid[best]) >= bound_s - _STEPS_S[-1] / 2:
        return TimeOffset(None, float(values[best]), f"the rotation rates agree best at the bound of {bound_s:g} s: the true offset is larger, or there is none to find")
    return TimeOffset(round(float(grid[best]), 6), float(values[best]))


def fit_lever_arm(score: Score, estimate: Trajectory) -> LeverArm:
    """The camera's place on the body for which the aligned estimate fits best, by least squares over alignment and lever arm together."""
    if score.alignment is None or score.reference is None or score.estimate_index is None:
        return LeverArm(None, "too few pairs")
    rotations, body = score.reference[:, :3, :3], score.reference[:, :3, 3]
    turn = np.degrees(np.sqrt(np.mean((Rotation.from_matrix(rotations).mean().inv() * Rotation.from_matrix(rotations)).magnitude() ** 2)))
    if turn < MIN_TURN_DEG:
        return LeverArm(None, f"the body turns by {turn:.1f} deg (RMS), {MIN_TURN_DEG:g} are needed")
    camera = estimate.poses[score.estimate_index][:, :3, 3]
    start = align(camera, body)
    centre, size = camera.mean(axis=0), max(float(np.ptp(body, axis=0).max()), 1e-9)

    def residuals(x: FloatArray) -> FloatArray:
        placed = start.scale * np.exp(x[3]) * Rotation.from_rotvec(x[:3]).apply((camera - centre) @ start.rotation.T) + x[4:7]
        return np.concatenate([((placed - body - rotations @ x[7:]) / size).ravel(), _RIDGE * x[7:]])

    begin = np.concatenate([np.zeros(4), start.scale * start.rotation @ centre + start.translation, np.zeros(3)])
    return LeverArm(np.asarray(least_squares(residuals, begin, x_scale="jac").x[7:]))


def with_offset(groundtruth: Trajectory, seconds: float) -> Trajectory:
    """The reference on the images' clock."""
    return Trajectory(groundtruth.stamps_ns + round(seconds * NS_PER_S), groundtruth.poses)


def with_lever_arm(groundtruth: Trajectory, body: FloatArray) -> Trajectory:
    """The reference moved from the body's origin to the camera at `body` (3,); orientations stay those of the body."""
    poses = groundtruth.poses.copy()
    poses[:, :3, 3] += poses[:, :3, :3] @ body
    return Trajectory(groundtruth.stamps_ns, poses)


def _rate_pairs(stamps_ns: IntArray) -> tuple[IntArray, IntArray]:
    """Indices of pairs of poses about `_BASELINE_NS` apart, without those over a gap."""
    second = np.searchsorted(stamps_ns, stamps_ns + _BASELINE_NS)
    first = np.flatnonzero(second < len(stamps_ns))
    second = second[first]
    short = stamps_ns[second] - stamps_ns[first] <= MAX_GAP_NS
    return first[short], second[short]


def _correlation(rates: FloatArray, groundtruth: Trajectory, stamps_ns: IntArray, first: IntArray, second: IntArray, offset_ns: int) -> float:
    begin, known0 = _at(groundtruth, stamps_ns[first] - offset_ns)
    end, known1 = _at(groundtruth, stamps_ns[second] - offset_ns)
    known = known0 & known1
    if known.sum() < max(_MIN_RATES, len(rates) // 2):
        return -1.0
    truth = _angles(begin[known], end[known]) / (stamps_ns[second] - stamps_ns[first])[known]
    if np.std(truth) * NS_PER_S < _STILL_RAD_S or np.std(rates[known]) == 0:
        return -1.0
    return float(np.corrcoef(rates[known], truth)[0, 1])


def _at(groundtruth: Trajectory, stamps_ns: IntArray) -> tuple[FloatArray, BoolArray]:
    return reference_at(groundtruth, stamps_ns, np.full(len(stamps_ns), UNMATCHED), MAX_GAP_NS)


def _angles(first: FloatArray, second: FloatArray) -> FloatArray:
    turns = np.swapaxes(first[:, :3, :3], 1, 2) @ second[:, :3, :3]
    return np.asarray(Rotation.from_matrix(turns).magnitude())
