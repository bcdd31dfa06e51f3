"""Bundle adjustment of keyframes and points (paper Sec. III-C, III-D): what takes part, in which order, and what is an outlier."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry import poses
from thegra_core.optimization.factor_graph import FactorGraph
from thegra_core.optimization.schur import SchurSystem
from thegra_core.optimization.undetermined import undetermined
from thegra_core.optimization.weighting import landmark_weights

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

GROSS = 16.0
"""Times the gate, or the median if that is more: squared errors at the start that are no error of the start."""


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


class Minimizer(Protocol):
    """Minimises the weighted Huber cost of a problem's observations."""

    def minimize(
        self, world_from_camera: FloatArray, points_world: FloatArray, used: BoolArray, keyframe_rows: IntArray, point_rows: IntArray,
        scale_from: tuple[int, int] | None, iterations: int, tolerance: float,
    ) -> tuple[FloatArray, FloatArray] | None:  # fmt: skip
        """Poses (K, 4, 4) and points (P, 3) from where they start, None where that is indeterminate.

        Only observations `used` (M,) count, those of `keyframe_rows` and `point_rows`. scale_from: rows of the only fixed pose and of a free one, whose
        distance may hold the scale, which is free then and is restored by the caller.
        """


MINIMIZERS: dict[str, Callable[[BundleProblem, float], Minimizer]] = {"gtsam": FactorGraph, "schur": SchurSystem}
"""By name: gtsam's factor graph, for any number of keyframes; the compiled Schur complement, for tens."""


def bundle_adjust(
    problem: BundleProblem, huber_px: float, chi2_px2: float, iterations: int, tolerance: float = 1e-5, solver: str = "gtsam", freedom: float = 0.0, weighings: int = 1
) -> BundleResult:
    """Minimise Huber(e^T Omega e) over poses and points in stages; outliers are left out of the next and marked again at the end. Points that their views do
    not tell take no part: those views may be a few of many.

    A stage ends after `iterations` steps (the first after half of them), or when a step lessens the cost by less than its share `tolerance`. After the first,
    `weighings` follow, each with the points weighed by what the last left of their errors, see `landmark_weights`.

    freedom: That of `landmark_weights`; with 0 all points count alike and one stage follows.
    solver: One of `MINIMIZERS`. A solve that is given up (an indeterminate system) returns the problem's own poses and points.
    """
    camera, points = problem.world_from_camera, problem.points_world
    errors = squared_errors(problem, camera, points)
    used = errors < _gross(errors, chi2_px2)
    minimizer = MINIMIZERS[solver](problem, huber_px)
    for stage in range(1 + (weighings if freedom else 1)):
        if stage and freedom:
            weights = problem.weights * landmark_weights(errors, problem.point_index, used, len(points), freedom)
            minimizer = MINIMIZERS[solver](replace(problem, weights=weights), huber_px)
        camera, points = _solve(problem, minimizer, camera, points, used, iterations if stage else max(iterations // 2, 1), tolerance)
        errors = squared_errors(problem, camera, points)
        used = errors < chi2_px2
    return BundleResult(camera, points, ~used, errors)


def squared_errors(problem: BundleProblem, world_from_camera: FloatArray, points_world: FloatArray) -> FloatArray:
    """Squared reprojection errors (M,) in px^2; inf behind the camera."""
    camera_from_world = np.stack([poses.inverse(pose) for pose in world_from_camera])[problem.keyframe_index]
    points = np.einsum("mij,mj->mi", camera_from_world[:, :3, :3], points_world[problem.point_index]) + camera_from_world[:, :3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = problem.focal**2 * ((points[:, :2] / points[:, 2:] - problem.normalized) ** 2).sum(axis=1)
    return np.where(points[:, 2] > 1e-9, errors, np.inf)


def _gross(errors: FloatArray, chi2_px2: float) -> float:
    """Squared error (px^2) beyond which an observation is left out from the start: Huber's kernel gives each wrong match the pull of a good one, and
    where the baseline is short many of them together bend the scene. Wide enough for a start that is bad as a whole."""
    finite = errors[np.isfinite(errors)]
    return max(GROSS * chi2_px2, GROSS * float(np.median(finite))) if len(finite) else np.inf


def _solve(
    problem: BundleProblem, minimizer: Minimizer, world_from_camera: FloatArray, points_world: FloatArray, used: BoolArray, iterations: int, tolerance: float
) -> tuple[FloatArray, FloatArray]:
    seen = np.bincount(problem.point_index[used], minlength=len(points_world))
    used = used & (seen[problem.point_index] >= 2)
    camera_from_world = np.stack([poses.inverse(pose) for pose in world_from_camera])
    used &= ~undetermined(camera_from_world, points_world, problem.keyframe_index[used], problem.point_index[used])[problem.point_index]
    point_rows = np.flatnonzero(np.bincount(problem.point_index[used], minlength=len(points_world)))
    keyframe_rows = np.flatnonzero(np.bincount(problem.keyframe_index[used], minlength=len(world_from_camera)))
    if len(point_rows) == 0 or bool(np.all(problem.fixed[keyframe_rows])):
        return world_from_camera, points_world
    scale_from = _scale_baseline(world_from_camera, problem.fixed, keyframe_rows)
    found = minimizer.minimize(world_from_camera, points_world, used, keyframe_rows, point_rows, scale_from, iterations, tolerance)
    if found is None:
        return world_from_camera, points_world
    if scale_from is not None:
        _restore_scale(world_from_camera, *found, keyframe_rows, point_rows, *scale_from)
    return found


def _scale_baseline(world_from_camera: FloatArray, fixed: BoolArray, keyframe_rows: IntArray) -> tuple[int, int] | None:
    """With a single fixed pose the scale is free: rows of that pose and of the one farthest from it, whose distance shall stay."""
    held = keyframe_rows[fixed[keyframe_rows]]
    if len(held) != 1:
        return None
    distance = np.linalg.norm(world_from_camera[keyframe_rows, :3, 3] - world_from_camera[held[0], :3, 3], axis=1)
    far = int(np.argmax(distance))
    return (int(held[0]), int(keyframe_rows[far])) if distance[far] > 0 else None


def _restore_scale(
    before: FloatArray, camera: FloatArray, points: FloatArray, keyframe_rows: IntArray, point_rows: IntArray, held: int, far: int
) -> None:
    """Take out what little the scale has drifted, in place, about the fixed pose."""
    center = before[held, :3, 3]
    factor = np.linalg.norm(before[far, :3, 3] - center) / max(float(np.linalg.norm(camera[far, :3, 3] - center)), 1e-12)
    free = keyframe_rows[keyframe_rows != held]
    camera[free, :3, 3] = center + factor * (camera[free, :3, 3] - center)
    points[point_rows] = center + factor * (points[point_rows] - center)
