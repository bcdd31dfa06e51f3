"""Bundle adjustment of keyframes and points (paper Sec. III-C, III-D) on gtsam's C++ factors.

gtsam holds the interpreter's lock for a whole solve: a live system runs this in the mapping process.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import P, X
from numpy.typing import NDArray

from thegra_core.geometry import poses

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

FIXED_SIGMA = 1e-6
"""Standard deviation (rad, map units) of the fixed pose from which a free scale is held; other fixed poses are no variables."""
SCALE_SIGMA = 0.1
"""Standard deviation, in its own length, of the distance that holds a free scale. Nothing in the images speaks against it, so a loose one holds as
well as a tight one; a tight one would let the poses move only along a sphere and stop every step that is larger than its width."""
GROSS = 16.0
"""Times the gate, or the median if that is more: squared errors at the start that are no error of the start."""
WEIGHT_STEPS_PER_OCTAVE = 4
"""Weights share noise models on a logarithmic grid this fine: a model for each observation would double the time to build the graph."""


@dataclass(frozen=True, slots=True)
class BundleProblem:
    """world_from_camera (K, 4, 4); fixed (K,) bool; points_world (P, 3); M observations: keyframe_index (M,), point_index (M,) rows of the former,
    normalized (M, 2) undistorted, weights (M,) 1/px^2; focal px."""

    world_from_camera: FloatArray
    fixed: BoolArray
    points_world: FloatArray
    keyframe_index: IntArray
    point_index: IntArray
    normalized: FloatArray
    weights: FloatArray
    focal: float


@dataclass(frozen=True, slots=True)
class BundleResult:
    """Optimised world_from_camera (K, 4, 4) and points_world (P, 3); outliers (M,) bool; squared pixel errors (M,), inf behind a camera."""

    world_from_camera: FloatArray
    points_world: FloatArray
    outliers: BoolArray
    squared_errors: FloatArray


def bundle_adjust(problem: BundleProblem, huber_px: float, chi2_px2: float, iterations: int, tolerance: float = 1e-5) -> BundleResult:
    """Minimise Huber(e^T Omega e) over poses and points in two stages; outliers are left out of the second and marked again at the end.

    A stage ends after `iterations` steps (the first after half of them), or when a step lessens the cost by less than its share `tolerance`.

    A solve that gtsam gives up on (an indeterminate system) returns the problem's own poses and points.
    """
    used = ~_outliers(problem, problem.world_from_camera, problem.points_world, _gross(problem, chi2_px2))
    camera, points = problem.world_from_camera, problem.points_world
    factors = _projections(problem, huber_px)
    for stage_iterations in (max(iterations // 2, 1), iterations):
        camera, points = _solve(problem, factors, camera, points, used, stage_iterations, tolerance)
        used = ~_outliers(problem, camera, points, chi2_px2)
    errors = squared_errors(problem, camera, points)
    return BundleResult(camera, points, ~used, errors)


def squared_errors(problem: BundleProblem, world_from_camera: FloatArray, points_world: FloatArray) -> FloatArray:
    """Squared reprojection errors (M,) in px^2; inf behind the camera."""
    camera_from_world = np.stack([poses.inverse(pose) for pose in world_from_camera])[problem.keyframe_index]
    points = np.einsum("mij,mj->mi", camera_from_world[:, :3, :3], points_world[problem.point_index]) + camera_from_world[:, :3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = problem.focal**2 * ((points[:, :2] / points[:, 2:] - problem.normalized) ** 2).sum(axis=1)
    return np.where(points[:, 2] > 1e-9, errors, np.inf)


def _outliers(problem: BundleProblem, world_from_camera: FloatArray, points_world: FloatArray, chi2_px2: float) -> BoolArray:
    with np.errstate(invalid="ignore"):
        return ~(squared_errors(problem, world_from_camera, points_world) < chi2_px2)


def _gross(problem: BundleProblem, chi2_px2: float) -> float:
    """Squared error (px^2) beyond which an observation is left out from the start: Huber's kernel gives each wrong match the pull of a good one, and
    where the baseline is short many of them together bend the scene. Wide enough for a start that is bad as a whole."""
    errors = squared_errors(problem, problem.world_from_camera, problem.points_world)
    finite = errors[np.isfinite(errors)]
    return max(GROSS * chi2_px2, GROSS * float(np.median(finite))) if len(finite) else np.inf


def _solve(
    problem: BundleProblem,
    factors: list[gtsam.NonlinearFactor],
    world_from_camera: FloatArray,
    points_world: FloatArray,
    used: BoolArray,
    iterations: int,
    tolerance: float,
) -> tuple[FloatArray, FloatArray]:
    seen = np.bincount(problem.point_index[used], minlength=len(points_world))
    used = used & (seen[problem.point_index] >= 2)
    point_rows = np.flatnonzero(np.bincount(problem.point_index[used], minlength=len(points_world)))
    keyframe_rows = np.flatnonzero(np.bincount(problem.keyframe_index[used], minlength=len(world_from_camera)))
    if len(point_rows) == 0 or bool(np.all(problem.fixed[keyframe_rows])):
        return world_from_camera, points_world

    graph, values, ordering = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Ordering()
    for row in point_rows:
        values.insert(P(int(row)), points_world[row])
        ordering.push_back(P(int(row)))
    for row in keyframe_rows[~problem.fixed[keyframe_rows]]:
        values.insert(X(int(row)), gtsam.Pose3(world_from_camera[row]))
        ordering.push_back(X(int(row)))
    scale_from = _scale_baseline(world_from_camera, problem.fixed, keyframe_rows)
    if scale_from is not None:
        _hold_scale(graph, values, ordering, world_from_camera, *scale_from)
    for m in np.flatnonzero(used).tolist():
        graph.push_back(factors[m])

    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setOrdering(ordering)
    parameters.setMaxIterations(iterations)
    parameters.setRelativeErrorTol(tolerance)
    parameters.setLinearSolverType("SEQUENTIAL_CHOLESKY")  # the same result; measured: 11 to 17 % less time than the multifrontal default
    try:
        result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    except RuntimeError:  # gtsam.IndeterminantLinearSystemException: a point or pose without enough constraints
        return world_from_camera, points_world

    camera, points = world_from_camera.copy(), points_world.copy()
    for row in keyframe_rows:
        if not problem.fixed[row]:
            camera[row] = result.atPose3(X(int(row))).matrix()
    for row in point_rows:
        points[row] = result.atPoint3(P(int(row)))
    if scale_from is not None:
        _restore_scale(world_from_camera, camera, points, keyframe_rows, point_rows, *scale_from)
    return camera, points


def _scale_baseline(world_from_camera: FloatArray, fixed: BoolArray, keyframe_rows: IntArray) -> tuple[int, int] | None:
    """With a single fixed pose the scale is free: rows of that pose and of the one farthest from it, whose distance shall stay."""
    held = keyframe_rows[fixed[keyframe_rows]]
    if len(held) != 1:
        return None
    distance = np.linalg.norm(world_from_camera[keyframe_rows, :3, 3] - world_from_camera[held[0], :3, 3], axis=1)
    far = int(np.argmax(distance))
    return (int(held[0]), int(keyframe_rows[far])) if distance[far] > 0 else None


def _hold_scale(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering, world_from_camera: FloatArray, held: int, far: int
) -> None:
    """Add the held pose as a variable, for the distance to it to be a factor; its observations do not need it."""
    pose = gtsam.Pose3(world_from_camera[held])
    values.insert(X(held), pose)
    ordering.push_back(X(held))
    graph.add(gtsam.PriorFactorPose3(X(held), pose, gtsam.noiseModel.Isotropic.Sigma(6, FIXED_SIGMA)))
    distance = float(np.linalg.norm(world_from_camera[far, :3, 3] - world_from_camera[held, :3, 3]))
    graph.add(gtsam.RangeFactorPose3(X(held), X(far), distance, gtsam.noiseModel.Isotropic.Sigma(1, SCALE_SIGMA * distance)))


def _restore_scale(
    before: FloatArray, camera: FloatArray, points: FloatArray, keyframe_rows: IntArray, point_rows: IntArray, held: int, far: int
) -> None:
    """Take out what little the scale has drifted, in place, about the fixed pose."""
    center = before[held, :3, 3]
    factor = np.linalg.norm(before[far, :3, 3] - center) / max(float(np.linalg.norm(camera[far, :3, 3] - center)), 1e-12)
    free = keyframe_rows[keyframe_rows != held]
    camera[free, :3, 3] = center + factor * (camera[free, :3, 3] - center)
    points[point_rows] = center + factor * (points[point_rows] - center)


def _projections(problem: BundleProblem, huber_px: float) -> list[gtsam.NonlinearFactor]:
    """A factor for each observation; those of fixed keyframes concern their point alone."""
    calibration = gtsam.Cal3_S2(problem.focal, problem.focal, 0.0, 0.0, 0.0)
    kernel = gtsam.noiseModel.mEstimator.Huber.Create(huber_px)
    steps = np.round(WEIGHT_STEPS_PER_OCTAVE * np.log2(np.maximum(problem.weights, 1e-12))).astype(int)
    models = {
        int(step): gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Isotropic.Sigma(2, float(2.0 ** (-0.5 * step / WEIGHT_STEPS_PER_OCTAVE))))
        for step in np.unique(steps)
    }
    fixed = {int(row): gtsam.PinholeCameraCal3_S2(gtsam.Pose3(problem.world_from_camera[row]), calibration) for row in np.flatnonzero(problem.fixed)}
    measured = problem.focal * problem.normalized
    observations = zip(problem.keyframe_index.tolist(), problem.point_index.tolist(), steps.tolist(), measured, strict=True)
    return [
        gtsam.TriangulationFactorCal3_S2(fixed[row], pixel, models[step], P(point))
        if row in fixed
        else gtsam.GenericProjectionFactorCal3_S2(pixel, models[step], X(row), P(point), calibration)
        for row, point, step, pixel in observations
    ]
