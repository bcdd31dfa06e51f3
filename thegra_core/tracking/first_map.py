"""A first map under one motion hypothesis: triangulate, place the frames between, adjust all, and say how well it explains every match."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import ThegraConfig
from thegra_core.geometry import poses, triangulation
from thegra_core.optimization.bundle import BundleProblem, bundle_adjust, squared_errors
from thegra_core.optimization.pose import estimate_pose, refine_pose

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

MIN_POINT_PARALLAX_DEG = 0.36
"""Points with less between reference and current frame are left out (ORB-SLAM3: cos < 0.99998)."""


@dataclass(frozen=True, slots=True)
class TrackTable:
    """Keypoints of V views that were matched to the same M keypoints of the first: normalized (V, M, 2), NaN where a view has no match; the
    last view, like the first, has all. weights (V, M) in 1/px^2."""

    normalized: FloatArray
    weights: FloatArray
    focal: float


@dataclass(frozen=True, slots=True)
class FirstMap:
    """world_from_camera (V, 4, 4) with the first at the origin; points_world (M, 3); good (M,) points to keep; used (V, M) observations to keep;
    cost: mean of min(e^2, chi2) over all matches, px^2; parallax_deg: median over the good points."""

    world_from_camera: FloatArray
    points_world: FloatArray
    good: BoolArray
    used: BoolArray
    cost: float
    parallax_deg: float
    model: str


def solve_first_map(table: TrackTable, last_from_first: FloatArray, model: str, config: ThegraConfig) -> FirstMap | None:
    """Bundle-adjusted map under a hypothesis for the motion from the first view to the last; None if it places too few points."""
    first, last = table.normalized[0], table.normalized[-1]
    points = triangulation.triangulate(np.eye(4), last_from_first, first, last)
    limit = 2 * config.initialization.max_reprojection_px / table.focal
    good = _well_placed(points, np.eye(4), last_from_first, first, last, limit)
    if good.sum() < config.initialization.min_points // 2:
        return None
    views = _place_between(table, points, good, last_from_first, config)
    if views is None:
        return None
    problem = _problem(table, views, points, good)
    result = bundle_adjust(problem, config.bundle.huber_px, config.bundle.chi2_px2, config.bundle.full_iterations, config.bundle.full_tolerance)
    return _judge(table, problem, result.world_from_camera, result.points_world, model, config)


def distinct(a: FirstMap, b: FirstMap) -> bool:
    """Whether two solved hypotheses are different motions: over 1 degree in rotation or 10 in the direction of translation."""
    rotation = poses.rotation_angle(a.world_from_camera[-1][:3, :3].T @ b.world_from_camera[-1][:3, :3])
    ta, tb = a.world_from_camera[-1][:3, 3], b.world_from_camera[-1][:3, 3]
    cosine = float(ta @ tb / max(np.linalg.norm(ta) * np.linalg.norm(tb), 1e-12))
    return bool(rotation > np.radians(1.0) or cosine < np.cos(np.radians(10.0)))


def _well_placed(points: FloatArray, camera0: FloatArray, camera1: FloatArray, x0: FloatArray, x1: FloatArray, limit: float) -> BoolArray:
    finite = np.asarray(np.isfinite(points).all(axis=1))
    safe = np.where(finite[:, None], points, 0.0)
    return (
        finite & (triangulation.reprojection_errors(camera0, safe, x0) < limit) & (triangulation.reprojection_errors(camera1, safe, x1) < limit)
    )


def _place_between(table: TrackTable, points: FloatArray, good: BoolArray, last_from_first: FloatArray, config: ThegraConfig) -> FloatArray | None:
    """camera_from_world (V, 4, 4) of all views, those between by their matches to the points placed by first and last."""
    views = [np.eye(4)]
    for view in range(1, len(table.normalized) - 1):
        seen = good & np.isfinite(table.normalized[view]).all(axis=1)
        if seen.sum() < 8:
            return None
        pose, inliers = estimate_pose(points[seen], table.normalized[view][seen], table.focal, 8.0, config.seed)
        if inliers < 6:
            return None
        ones = np.ones(int(seen.sum()))
        views.append(refine_pose(pose, points[seen], table.normalized[view][seen], table.focal, ones, 16 * config.bundle.chi2_px2).camera_from_world)
    views.append(last_from_first)
    return np.stack(views)


def _problem(table: TrackTable, camera_from_world: FloatArray, points: FloatArray, good: BoolArray) -> BundleProblem:
    """All matches as observations; points that could not be placed are put at a finite spot where they count as outliers."""
    seen = np.isfinite(table.normalized).all(axis=2)
    view, point = np.nonzero(seen)
    placed = np.where(good[:, None], points, np.array([0.0, 0.0, -1.0]))
    return BundleProblem(
        world_from_camera=np.stack([poses.inverse(pose) for pose in camera_from_world]),
        fixed=np.arange(len(camera_from_world)) == 0,
        points_world=placed,
        keyframe_index=view.astype(np.int64),
        point_index=point.astype(np.int64),
        normalized=table.normalized[view, point],
        weights=table.weights[view, point],
        focal=table.focal,
    )


def _judge(
    table: TrackTable, problem: BundleProblem, world_from_camera: FloatArray, points: FloatArray, model: str, config: ThegraConfig
) -> FirstMap:
    chi2, limit = config.bundle.chi2_px2, config.initialization.max_reprojection_px**2
    seen = np.isfinite(table.normalized).all(axis=2)

    def errors_of(points_world: FloatArray) -> FloatArray:
        errors = np.full(seen.shape, np.inf)
        errors[problem.keyframe_index, problem.point_index] = squared_errors(problem, world_from_camera, points_world)
        return errors

    # a point the start left out may fit the adjusted poses: place it anew, by the two views whose match is the claim; one wrong match between must not move it
    errors = errors_of(points)
    first, last = poses.inverse(world_from_camera[0]), poses.inverse(world_from_camera[-1])
    again = triangulation.triangulate(first, last, table.normalized[0], table.normalized[-1])
    adjusted = (errors[0] < limit) & (errors[-1] < limit)
    points = np.where(adjusted[:, None], points, np.where(np.isfinite(again), again, -1.0))
    errors = errors_of(points)
    used = errors < chi2
    parallax = np.degrees(triangulation.parallax(world_from_camera[0][:3, 3], world_from_camera[-1][:3, 3], points))
    good = (errors[0] < limit) & (errors[-1] < limit) & (parallax > MIN_POINT_PARALLAX_DEG)
    return FirstMap(
        world_from_camera=world_from_camera,
        points_world=points,
        good=good,
        used=used & good,
        cost=float(np.minimum(errors[seen], chi2).mean()),
        parallax_deg=float(np.median(parallax[good])) if good.any() else 0.0,
        model=model,
    )
