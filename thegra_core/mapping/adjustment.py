"""Local and full bundle adjustment of a map: which keyframes and points take part, and what happens to the outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import ThegraConfig
from thegra_core.map.editor import MapEditor
from thegra_core.optimization.bundle import BundleProblem, BundleResult
from thegra_core.optimization.solver import BundleTask
from thegra_core.optimization.weighting import observation_weights

IntArray = NDArray[np.int64]
FULL_WEIGHINGS = 3
"""Times that a full adjustment weighs its landmarks anew: a local one does so once, for the next comes soon."""


@dataclass(frozen=True, slots=True)
class Adjustment:
    """A part of a map as a bundle adjustment: the task, and what its rows are.

    keyframe_ids (K,), landmark_ids (P,); keypoint `feature` (M,) of keyframe `observer` (M,) makes an observation.
    """

    keyframe_ids: IntArray
    landmark_ids: IntArray
    observer: IntArray
    feature: IntArray
    task: BundleTask

    def outlier_observations(self, result: BundleResult) -> list[tuple[int, int, int]]:
        """Landmark id, keyframe id and keypoint of each observation that the result does not fit."""
        rows = np.flatnonzero(result.outliers)
        landmarks = self.landmark_ids[self.task.problem.point_index[rows]]
        return list(zip(landmarks.tolist(), self.observer[rows].tolist(), self.feature[rows].tolist(), strict=True))


def adjust_locally(editor: MapEditor, keyframe_id: int, config: ThegraConfig) -> None:
    """Local bundle adjustment (paper Sec. III-C): the keyframe, its best neighbours and their landmarks move; other observers stay fixed."""
    local = [keyframe_id, *editor.map.neighbours(keyframe_id, config.bundle.local_keyframes - 1)]
    landmarks = editor.map.landmark_ids_of(local)
    _, observers, _ = editor.observations(landmarks)
    ids, counts = np.unique(observers[~np.isin(observers, local)], return_counts=True)
    outer = ids[np.argsort(-counts, kind="stable")][: config.bundle.fixed_keyframes].tolist()
    if not outer:  # the whole map is local: its oldest keyframe holds the frame
        outer = [min(local)]
        local = [i for i in local if i not in outer]
    _solve(editor, _adjustment(editor, sorted(local), sorted(outer), landmarks, config, config.bundle.iterations, config.bundle.tolerance, config.bundle.local_solver))


def adjust_all(editor: MapEditor, config: ThegraConfig) -> None:
    """Full bundle adjustment, at once; the first keyframe is held."""
    _solve(editor, full_adjustment(editor, config))


def full_adjustment(editor: MapEditor, config: ThegraConfig) -> Adjustment | None:
    """The map as it is as a full bundle adjustment, in which the first keyframe is held; None if there is nothing to adjust."""
    ids = sorted(editor.map.keyframes)
    return _adjustment(editor, ids[1:], ids[:1], editor.map.landmarks.alive_ids(), config, config.bundle.full_iterations, config.bundle.full_tolerance, weighings=FULL_WEIGHINGS)


def _solve(editor: MapEditor, adjustment: Adjustment | None) -> None:
    if adjustment is None:
        return
    result = adjustment.task.solve()
    moved = ~adjustment.task.problem.fixed
    editor.move(adjustment.keyframe_ids[moved], result.world_from_camera[moved], adjustment.landmark_ids, result.points_world)
    for landmark, keyframe_id, _ in adjustment.outlier_observations(result):
        editor.forget_observation(landmark, keyframe_id)


def _adjustment(
    editor: MapEditor, free: list[int], fixed: list[int], landmarks: IntArray, config: ThegraConfig, iterations: int, tolerance: float,
    solver: str = "gtsam", weighings: int = 1,
) -> Adjustment | None:  # fmt: skip
    if not free or len(landmarks) == 0:
        return None
    keyframe_ids = np.array([*free, *fixed], dtype=np.int64)
    point, observer, feature = editor.observations(landmarks)
    taking_part = np.isin(observer, keyframe_ids)
    point, observer, feature = point[taking_part], observer[taking_part], feature[taking_part]
    by_id = np.argsort(keyframe_ids)
    row = by_id[np.searchsorted(keyframe_ids, observer, sorter=by_id)]
    normalized, weights = np.empty((len(point), 2)), np.empty(len(point))
    for keyframe_row, keyframe_id in enumerate(keyframe_ids.tolist()):
        mine = np.flatnonzero(row == keyframe_row)
        keyframe = editor.map.keyframes[keyframe_id]
        normalized[mine] = keyframe.normalized[feature[mine]]
        weights[mine] = observation_weights(keyframe.features.scores, config.weighting)[feature[mine]]
    problem = BundleProblem(
        world_from_camera=np.stack([editor.map.keyframes[int(i)].world_from_camera for i in keyframe_ids]),
        fixed=np.arange(len(keyframe_ids)) >= len(free),
        points_world=editor.map.landmarks.points_world[editor.map.landmarks.rows(landmarks)].copy(),
        keyframe_index=row,
        point_index=point,
        normalized=normalized,
        weights=weights,
        focal=editor.map.camera.focal,
    )
    bundle = config.bundle
    task = BundleTask(problem, bundle.huber_px, bundle.chi2_px2, iterations, tolerance, solver, bundle.landmark_freedom, weighings)
    return Adjustment(keyframe_ids, landmarks, observer, feature, task)
