"""New landmarks and observations from matches of two keyframes (paper Sec. III-C, Keyframe Insertion and Map Expansion)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import MappingConfig
from thegra_core.geometry import epipolar, poses, triangulation
from thegra_core.map.editor import MapEditor
from thegra_core.map.map import MapKeyframe
from thegra_core.messages import NO_LANDMARK, Matches

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


def expand(editor: MapEditor, keyframe_id: int, neighbour_id: int, matches: Matches, config: MappingConfig) -> int:
    """Use the matches (query: keyframe, reference: neighbour) of two keyframes; returns how many landmarks were created.

    Where one side sees a landmark the other joins it, where both see different ones they are fused, where neither does a point is
    triangulated. Everything must reproject, and a new point must pass `accept_points`.
    """
    keyframe, neighbour = editor.map.keyframes[keyframe_id], editor.map.keyframes[neighbour_id]
    query, reference = matches.indices[:, 0].astype(np.int64), matches.indices[:, 1].astype(np.int64)
    defined = np.isfinite(keyframe.normalized[query]).all(axis=1) & np.isfinite(neighbour.normalized[reference]).all(axis=1)
    query, reference = query[defined], reference[defined]
    _join(editor, keyframe, neighbour, query, reference, config)
    _join(editor, neighbour, keyframe, reference, query, config)
    free = (keyframe.landmark_ids[query] == NO_LANDMARK) & (neighbour.landmark_ids[reference] == NO_LANDMARK)
    query, reference = query[free], reference[free]
    points, good = accept_points(keyframe, neighbour, query, reference, editor.map.camera.focal, config)
    ids = editor.add_landmarks(points[good], keyframe_id)
    for landmark, q, r in zip(ids.tolist(), query[good].tolist(), reference[good].tolist(), strict=True):
        editor.observe(landmark, keyframe_id, q)
        editor.observe(landmark, neighbour_id, r)
    return len(ids)


def accept_points(
    keyframe: MapKeyframe, neighbour: MapKeyframe, query: IntArray, reference: IntArray, focal: float, config: MappingConfig
) -> tuple[FloatArray, BoolArray]:
    """Triangulate keypoint pairs and test them: points_world (N, 3) and whether each passes.

    Before triangulation the epipolar constraint; after it positive depth in both views, parallax, reprojection error in both, and a
    scale consistent between the views (ratio of distances; the detectors have no octaves to compare it with).
    """
    x, y = keyframe.normalized[query], neighbour.normalized[reference]
    neighbour_from_keyframe = neighbour.camera_from_world @ keyframe.world_from_camera
    if np.linalg.norm(neighbour_from_keyframe[:3, 3]) < 1e-12 or len(query) == 0:
        return np.zeros((len(query), 3)), np.zeros(len(query), dtype=bool)
    good = focal * epipolar.sampson_errors(epipolar.essential(neighbour_from_keyframe), x, y) < config.epipolar_px
    points = triangulation.triangulate(keyframe.camera_from_world, neighbour.camera_from_world, x, y)
    good &= np.isfinite(points).all(axis=1)
    points = np.where(good[:, None], points, 0.0)
    good &= focal * triangulation.reprojection_errors(keyframe.camera_from_world, points, x) < config.max_reprojection_px
    good &= focal * triangulation.reprojection_errors(neighbour.camera_from_world, points, y) < config.max_reprojection_px
    good &= triangulation.parallax(keyframe.center, neighbour.center, points) > np.radians(config.min_parallax_deg)
    distance, other = np.linalg.norm(points - keyframe.center, axis=1), np.linalg.norm(points - neighbour.center, axis=1)
    ratio = np.maximum(distance, other) / np.maximum(np.minimum(distance, other), 1e-12)
    return points, good & (ratio < config.max_scale_ratio)


def _join(editor: MapEditor, seeing: MapKeyframe, other: MapKeyframe, seeing_index: IntArray, other_index: IntArray, config: MappingConfig) -> None:
    """Landmarks that `seeing` observes and whose match in `other` reprojects: observed by `other` too, or fused with what it observes there."""
    ids = seeing.landmark_ids[seeing_index]
    rows = editor.map.landmarks.rows(ids)
    with_landmark = np.flatnonzero(rows >= 0)
    if len(with_landmark) == 0:
        return
    points = editor.map.landmarks.points_world[rows[with_landmark]]
    error = editor.map.camera.focal * triangulation.reprojection_errors(
        poses.inverse(other.world_from_camera), points, other.normalized[other_index[with_landmark]]
    )
    for index in with_landmark[error < config.max_reprojection_px].tolist():
        landmark, feature = int(ids[index]), int(other_index[index])
        present = int(other.landmark_ids[feature])
        if present == NO_LANDMARK:
            if landmark in editor.observers:  # not fused away a moment ago
                editor.observe(landmark, other.id, feature)
        elif present != landmark:
            keep, drop = sorted((landmark, present), key=lambda i: (-len(editor.observers.get(i, ())), i))
            editor.fuse(keep, drop)
