"""Local and full bundle adjustment of a map: which keyframes and points take part, and what happens to the outliers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import ThegraConfig
from thegra_core.map.editor import MapEditor
from thegra_core.optimization.bundle import BundleProblem, bundle_adjust
from thegra_core.optimization.weighting import observation_weights

IntArray = NDArray[np.int64]


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
    _adjust(editor, sorted(local), sorted(outer), landmarks, config, config.bundle.iterations, config.bundle.tolerance)


def adjust_all(editor: MapEditor, config: ThegraConfig) -> None:
    """Full bundle adjustment; the first keyframe is held."""
    ids = sorted(editor.map.keyframes)
    if len(ids) < 2:
        return
    _adjust(editor, ids[1:], ids[:1], editor.map.landmarks.alive_ids(), config, config.bundle.full_iterations, config.bundle.full_tolerance)


def _adjust(editor: MapEditor, free: list[int], fixed: list[int], landmarks: IntArray, config: ThegraConfig, iterations: int, tolerance: float) -> None:
    if not free or len(landmarks) == 0:
        return
    keyframe_ids = np.array([*free, *fixed], dtype=np.int64)
    row_of = {int(keyframe_id): row for row, keyframe_id in enumerate(keyframe_ids)}
    point, observer, feature = editor.observations(landmarks)
    taking_part = np.isin(observer, keyframe_ids)
    point, observer, feature = point[taking_part], observer[taking_part], feature[taking_part]
    row = np.array([row_of[i] for i in observer.tolist()], dtype=np.int64)
    normalized, weights = np.empty((len(point), 2)), np.empty(len(point))
    for keyframe_id, keyframe_row in row_of.items():
        mine = row == keyframe_row
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
    result = bundle_adjust(problem, config.bundle.huber_px, config.bundle.chi2_px2, iterations, tolerance)
    moved = ~problem.fixed
    editor.move(keyframe_ids[moved], result.world_from_camera[moved], landmarks, result.points_world)
    for index in np.flatnonzero(result.outliers).tolist():
        editor.forget_observation(int(landmarks[point[index]]), int(observer[index]))
