"""The pose of a camera that sees few landmarks but shares many matches with posed cameras: landmarks give the scale, the matches the rest.

A match whose point was never triangulated still says that the point lies on a line in the image, one equation on the pose. Where a view has turned to a
part of the scene that the map hardly holds, such matches are most of what is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import poselib
from numpy.typing import NDArray

from thegra_core.geometry import epipolar, poses
from thegra_core.optimization.pose import pose_jacobian

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
ROUNDS, STEPS = 4, 10
SAMPLES = 100
"""Draws of three landmarks; with half of them wrong, one draw in eight is right."""
EPIPOLAR_CHI2 = 3.841
"""95 % of chi-square with the one degree of freedom that a match without a landmark has."""
_TURNS = np.stack([poses.skew(axis) for axis in np.eye(3)])
"""(3, 3, 3): how a small turn about each axis moves a vector."""


@dataclass(frozen=True, slots=True)
class LandmarkView:
    """Landmarks points_world (N, 3) seen at normalized (N, 2), with weights (N,) in 1/px^2."""

    points_world: FloatArray
    normalized: FloatArray
    weights: FloatArray


@dataclass(frozen=True, slots=True)
class SharedView:
    """Matches with a posed camera: its camera_from_world (4, 4), normalized there and here (M, 2), weights (M,) in 1/px^2."""

    camera_from_world: FloatArray
    there: FloatArray
    here: FloatArray
    weights: FloatArray


@dataclass(frozen=True, slots=True)
class HybridEstimate:
    """camera_from_world (4, 4); inliers (N,) bool of the landmarks; agreeing, per shared view (M,) bool of its matches; covariance (6, 6) as `PoseEstimate`'s."""

    camera_from_world: FloatArray
    inliers: BoolArray
    agreeing: tuple[BoolArray, ...]
    covariance: FloatArray

    @property
    def agreeing_matches(self) -> int:
        return sum(int(a.sum()) for a in self.agreeing)


def estimate_hybrid_pose(landmarks: LandmarkView, shared: Sequence[SharedView], focal: float, threshold_px: float, seed: int) -> FloatArray | None:
    """camera_from_world (4, 4) without a starting pose: the one from three landmarks (P3P, drawn `SAMPLES` times) that most landmarks and matches
    agree with, each as far as its error is below `threshold_px`. None with fewer than four landmarks or if no three give a pose.

    PoseLib has a RANSAC for this (`estimate_hybrid_pose`), whose results differ from call to call.
    """
    count = len(landmarks.points_world)
    if count < 4:
        return None
    rng = np.random.default_rng(seed)
    bearings = epipolar.homogeneous(landmarks.normalized)
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    drawn = []
    for _ in range(SAMPLES):
        three = rng.choice(count, 3, replace=False)
        for found in poselib.p3p(list(bearings[three]), list(landmarks.points_world[three])):
            pose = poses.transform(found.R, found.t)
            if np.all(np.isfinite(pose)):
                drawn.append(pose)
    if not drawn:
        return None
    agreement = _agreement(drawn, landmarks, shared, focal, threshold_px)
    best = int(np.argmax(agreement))
    return drawn[best] if agreement[best] > 0 else None


def _agreement(drawn: list[FloatArray], landmarks: LandmarkView, shared: Sequence[SharedView], focal: float, threshold_px: float) -> FloatArray:
    """Truncated quadratic scores (P,) of poses: 1 for each observation without error, 0 beyond the threshold. All at once takes a twentieth of the time."""
    stack = np.stack(drawn)
    points = landmarks.points_world @ stack[:, :3, :3].transpose(0, 2, 1) + stack[:, None, :3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        squared = focal**2 * _lengths2(points[..., :2] / points[..., 2:] - landmarks.normalized)
    scores = _truncated(np.where(points[..., 2] > 1e-9, squared, np.inf), threshold_px)
    for view in shared:
        essentials = epipolar.essential(stack @ poses.inverse(view.camera_from_world))
        there, here = epipolar.homogeneous(view.there), epipolar.homogeneous(view.here)
        lines_here, lines_there = there @ essentials.transpose(0, 2, 1), here @ essentials
        scale = _lengths2(lines_here[..., :2]) + _lengths2(lines_there[..., :2])
        scores += _truncated(focal**2 * np.einsum("pmi,mi->pm", lines_here, here) ** 2 / np.maximum(scale, 1e-30), threshold_px)
    return np.nan_to_num(scores, nan=0.0)


def _truncated(squared: FloatArray, threshold_px: float) -> FloatArray:
    """Sum over the last axis of 1 for an observation without error, 0 beyond the threshold."""
    return np.asarray(np.maximum(1.0 - squared / threshold_px**2, 0.0).sum(axis=-1))


def _lengths2(vectors: FloatArray) -> FloatArray:
    """Squared lengths (...) of vectors (..., D); numpy's sum over an axis of two or three takes five times as long."""
    return np.asarray(np.einsum("...i,...i->...", vectors, vectors))


def _squared_errors(pose: FloatArray, landmarks: LandmarkView, focal: float) -> FloatArray:
    """Squared reprojection errors (N,) in px^2, inf behind the camera."""
    points = poses.apply(pose, landmarks.points_world)
    with np.errstate(divide="ignore", invalid="ignore"):
        squared = focal**2 * _lengths2(points[:, :2] / points[:, 2:] - landmarks.normalized)
    return np.where(points[:, 2] > 1e-9, squared, np.inf)


def refine_hybrid_pose(camera_from_world: FloatArray, landmarks: LandmarkView, shared: Sequence[SharedView], focal: float, chi2: float) -> HybridEstimate:
    """Least robust weighted error of landmarks (reprojection) and matches (Sampson's distance) over one pose, both in px.

    Rounds and gates as `refine_pose`: after each, what lies beyond its gate sits out the next; the Huber kernel is off in the last.
    """
    pose = camera_from_world
    seen, agreeing = _gate(pose, landmarks, shared, focal, 16.0 * chi2)
    hessian = np.eye(6)
    for round_index in range(ROUNDS):
        huber = np.sqrt(chi2) if round_index < ROUNDS - 1 else np.inf
        pose, hessian = _gauss_newton(pose, _seen_part(landmarks, seen), [_shared_part(v, a) for v, a in zip(shared, agreeing, strict=True)], focal, huber)
        seen, agreeing = _gate(pose, landmarks, shared, focal, chi2)
        if seen.sum() < 2:
            break
    used = [_shared_part(v, a) for v, a in zip(shared, agreeing, strict=True)]
    residuals, weights, _ = _system(pose, _seen_part(landmarks, seen), used, focal)
    variance = float((weights * residuals**2).sum() / max(len(residuals) - 6, 1)) if len(residuals) else 1.0
    covariance = max(variance, 1e-12) * np.linalg.pinv(hessian, hermitian=True)
    return HybridEstimate(pose, seen, tuple(agreeing), np.asarray(covariance, dtype=np.float64))


def _gate(
    pose: FloatArray, landmarks: LandmarkView, shared: Sequence[SharedView], focal: float, chi2: float
) -> tuple[BoolArray, list[BoolArray]]:
    """Landmarks and matches within `chi2` px^2 of the pose; matches by the share of it that their one degree of freedom has."""
    seen = _squared_errors(pose, landmarks, focal) < chi2
    limit = chi2 * EPIPOLAR_CHI2 / 5.991
    return seen, [(focal * _sampson(pose, view)) ** 2 < limit for view in shared]


def _gauss_newton(pose: FloatArray, landmarks: LandmarkView, shared: Sequence[SharedView], focal: float, huber: float) -> tuple[FloatArray, FloatArray]:
    hessian = np.eye(6)
    for _ in range(STEPS):
        residuals, weights, jacobian = _system(pose, landmarks, shared, focal)
        if len(residuals) < 6:
            break
        robust = weights * np.minimum(1.0, huber / np.maximum(np.sqrt(weights) * np.abs(residuals), 1e-12))
        hessian = jacobian.T @ (robust[:, None] * jacobian)
        step = -np.linalg.solve(hessian + 1e-9 * np.trace(hessian) * np.eye(6), jacobian.T @ (robust * residuals))
        pose = _moved(pose, step)
        if float(np.abs(step).max()) < 1e-8:
            break
    return pose, hessian


def _system(
    pose: FloatArray, landmarks: LandmarkView, shared: Sequence[SharedView], focal: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (R,) px, weights (R,) and Jacobian (R, 6) by a left perturbation of the pose; landmarks behind the camera are left out."""
    points = poses.apply(pose, landmarks.points_world)
    front = points[:, 2] > 1e-9
    points = points[front]
    parts = [(
        focal * (points[:, :2] / points[:, 2:] - landmarks.normalized[front]).reshape(-1),
        np.repeat(landmarks.weights[front], 2),
        focal * pose_jacobian(points).reshape(-1, 6),
    )]  # fmt: skip
    parts += [(focal * _sampson(pose, view), view.weights, focal * _sampson_jacobian(pose, view)) for view in shared]
    residuals, weights, jacobian = (np.concatenate(x) for x in zip(*parts, strict=True))
    return residuals, weights, jacobian


def _sampson(pose: FloatArray, view: SharedView) -> FloatArray:
    """Signed Sampson distances (M,) on the plane z = 1."""
    return epipolar.signed_sampson_errors(epipolar.essential(pose @ poses.inverse(view.camera_from_world)), view.there, view.here)


def _sampson_jacobian(pose: FloatArray, view: SharedView) -> FloatArray:
    """(M, 6) of `_sampson` by a left perturbation of the pose. The distance does not change with the length of the translation, so that this is taken as it is."""
    relative = pose @ poses.inverse(view.camera_from_world)
    rotation, essential = relative[:3, :3], poses.skew(relative[:3, 3]) @ relative[:3, :3]
    changes = np.concatenate((_TURNS @ essential, _TURNS @ rotation))
    there, here = epipolar.homogeneous(view.there), epipolar.homogeneous(view.here)
    lines_here, lines_there = there @ essential.T, here @ essential
    moved_here, moved_there = there @ changes.transpose(0, 2, 1), here @ changes  # (6, M, 3)
    algebraic = np.einsum("mi,mi->m", lines_here, here)
    squared = np.maximum(_lengths2(lines_here[:, :2]) + _lengths2(lines_there[:, :2]), 1e-30)
    stretch = np.einsum("kmi,mi->km", moved_here[..., :2], lines_here[:, :2]) + np.einsum("kmi,mi->km", moved_there[..., :2], lines_there[:, :2])
    return np.asarray(((np.einsum("kmi,mi->km", moved_here, here) - algebraic / squared * stretch) / np.sqrt(squared)).T)


def _moved(pose: FloatArray, step: FloatArray) -> FloatArray:
    return poses.transform(poses.so3_exp(step[:3]), step[3:]) @ pose


def _seen_part(view: LandmarkView, keep: BoolArray) -> LandmarkView:
    return LandmarkView(view.points_world[keep], view.normalized[keep], view.weights[keep])


def _shared_part(view: SharedView, keep: BoolArray) -> SharedView:
    return SharedView(view.camera_from_world, view.there[keep], view.here[keep], view.weights[keep])
