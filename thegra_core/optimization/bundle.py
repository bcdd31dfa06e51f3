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
"""Standard deviation (rad, map units) that holds a fixed pose."""
WEIGHT_STEPS_PER_OCTAVE = 4
"""Weights share noise models on a logarithmic grid this fine: a model for each observation would double the time to build the graph."""


@dataclass(frozen=True, slots=True)
class BundleProblem:
    """world_from_camera (K, 4, 4); fixed (K,) bool; points_world (P, 3); M observations: keyframe_index (M,), point_index (M,) rows of the former,
    normalized (M, 2) undistorted, weights (M,) 1/px^2, gates (M,) factors of squared pixel residuals in the outlier test; focal px."""

    world_from_camera: FloatArray
    fixed: BoolArray
    points_world: FloatArray
    keyframe_index: IntArray
    point_index: IntArray
    normalized: FloatArray
    weights: FloatArray
    gates: FloatArray
    focal: float


@dataclass(frozen=True, slots=True)
class BundleResult:
    """Optimised world_from_camera (K, 4, 4) and points_world (P, 3); outliers (M,) bool; squared pixel errors (M,), inf behind a camera."""

    world_from_camera: FloatArray
    points_world: FloatArray
    outliers: BoolArray
    squared_errors: FloatArray


def bundle_adjust(problem: BundleProblem, huber_px: float, chi2_px2: float, iterations: int) -> BundleResult:
    """Minimise Huber(e^T Omega e) over poses and points in two stages; outliers are left out of the second and marked again at the end.

    A solve that gtsam gives up on (an indeterminate system) returns the problem's own poses and points.
    """
    used = ~_outliers(problem, problem.world_from_camera, problem.points_world, np.inf)
    camera, points = problem.world_from_camera, problem.points_world
    for stage_iterations in (max(iterations // 2, 1), iterations):
        camera, points = _solve(problem, camera, points, used, huber_px, stage_iterations)
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
        return ~(problem.gates * squared_errors(problem, world_from_camera, points_world) < chi2_px2)


def _solve(
    problem: BundleProblem, world_from_camera: FloatArray, points_world: FloatArray, used: BoolArray, huber_px: float, iterations: int
) -> tuple[FloatArray, FloatArray]:
    seen = np.bincount(problem.point_index[used], minlength=len(points_world))
    used = used & (seen[problem.point_index] >= 2)
    point_rows = np.flatnonzero(np.bincount(problem.point_index[used], minlength=len(points_world)))
    keyframe_rows = np.flatnonzero(np.bincount(problem.keyframe_index[used], minlength=len(world_from_camera)))
    if len(point_rows) == 0 or bool(np.all(problem.fixed[keyframe_rows])):
        return world_from_camera, points_world

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    held = gtsam.noiseModel.Isotropic.Sigma(6, FIXED_SIGMA)
    for row in keyframe_rows:
        pose = gtsam.Pose3(world_from_camera[row])
        values.insert(X(int(row)), pose)
        if problem.fixed[row]:
            graph.add(gtsam.PriorFactorPose3(X(int(row)), pose, held))
    for row in point_rows:
        values.insert(P(int(row)), points_world[row])
    _hold_scale(graph, world_from_camera, problem.fixed, keyframe_rows)
    _add_projections(graph, problem, used, huber_px)

    ordering = gtsam.Ordering()
    for row in point_rows:
        ordering.push_back(P(int(row)))
    for row in keyframe_rows:
        ordering.push_back(X(int(row)))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setOrdering(ordering)
    parameters.setMaxIterations(iterations)
    parameters.setRelativeErrorTol(1e-5)
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
    return camera, points


def _hold_scale(graph: gtsam.NonlinearFactorGraph, world_from_camera: FloatArray, fixed: BoolArray, keyframe_rows: IntArray) -> None:
    """With a single fixed pose the scale is free: keep the distance from it to the farthest other pose."""
    held = keyframe_rows[fixed[keyframe_rows]]
    if len(held) != 1:
        return
    distance = np.linalg.norm(world_from_camera[keyframe_rows, :3, 3] - world_from_camera[held[0], :3, 3], axis=1)
    far = int(np.argmax(distance))
    if distance[far] > 0:
        model = gtsam.noiseModel.Isotropic.Sigma(1, 1e-6 * float(distance[far]))
        graph.add(gtsam.RangeFactorPose3(X(int(held[0])), X(int(keyframe_rows[far])), float(distance[far]), model))


def _add_projections(graph: gtsam.NonlinearFactorGraph, problem: BundleProblem, used: BoolArray, huber_px: float) -> None:
    calibration = gtsam.Cal3_S2(problem.focal, problem.focal, 0.0, 0.0, 0.0)
    kernel = gtsam.noiseModel.mEstimator.Huber.Create(huber_px)
    steps = np.round(WEIGHT_STEPS_PER_OCTAVE * np.log2(np.maximum(problem.weights, 1e-12))).astype(int)
    models = {
        int(step): gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Isotropic.Sigma(2, float(2.0 ** (-0.5 * step / WEIGHT_STEPS_PER_OCTAVE))))
        for step in np.unique(steps[used])
    }
    measured = problem.focal * problem.normalized
    for m in np.flatnonzero(used):
        graph.add(
            gtsam.GenericProjectionFactorCal3_S2(
                measured[m], models[int(steps[m])], X(int(problem.keyframe_index[m])), P(int(problem.point_index[m])), calibration
            )
        )
