"""New landmarks and observations from matches of two keyframes (paper Sec. III-C, Keyframe Insertion and Map Expansion)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import MappingConfig
from thegra_core.geometry import epipolar, triangulation
from thegra_core.geometry.refinement import refine_points
from thegra_core.map.editor import MapEditor
from thegra_core.map.map import MapKeyframe
from thegra_core.messages import NO_LANDMARK, Matches

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
WORST_OF_MANY = 1.5
"""The worst of a landmark's observations may lie this many times further off than a single one: with half a dozen, one in four landmarks has such a one."""
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
    """Landmarks that `seeing` observes are observed by their matches in `other` too, or fused with what those observe.

    Where the landmark reprojects it is joined as it is. A landmark of two near views hardly has a depth yet and may reproject far off although the match is
    right: where the match fits the epipolar geometry the landmark is triangulated anew from all that would observe it, and joined if that fits all of them.
    """
    ids = seeing.landmark_ids[seeing_index]
    rows = editor.map.landmarks.rows(ids)
    candidate = np.flatnonzero((rows >= 0) & (ids != other.landmark_ids[other_index]))
    if len(candidate) == 0:
        return
    points = editor.map.landmarks.points_world[rows[candidate]]
    focal = editor.map.camera.focal
    error = focal * triangulation.reprojection_errors(other.camera_from_world, points, other.normalized[other_index[candidate]])
    fits = error < config.max_reprojection_px
    for index in candidate[fits].tolist():
        _merge(editor, int(ids[index]), other, int(other_index[index]))
    rest = candidate[~fits]
    other_from_seeing = other.camera_from_world @ seeing.world_from_camera
    essential = epipolar.essential(other_from_seeing)
    near = focal * epipolar.sampson_errors(essential, seeing.normalized[seeing_index[rest]], other.normalized[other_index[rest]]) < config.epipolar_px
    _join_anew(editor, ids[rest[near]].tolist(), other, other_index[rest[near]].tolist(), config)


def _join_anew(editor: MapEditor, landmarks: list[int], other: MapKeyframe, features: list[int], config: MappingConfig) -> None:
    """Join landmarks with keypoints of `other`, each at the point that all its observations then agree on, where there is one."""
    pairs: list[tuple[int, int]] = []
    views, normalized, index = [], [], []
    poses: dict[int, FloatArray] = {}
    for landmark, feature in zip(landmarks, features, strict=True):
        if landmark not in editor.observers or other.id in editor.observers[landmark]:
            continue
        observations = {**editor.observers.get(int(other.landmark_ids[feature]), {}), **editor.observers[landmark], other.id: feature}
        for keyframe_id, keypoint in observations.items():
            keyframe = editor.map.keyframes[keyframe_id]
            if keyframe_id not in poses:
                poses[keyframe_id] = keyframe.camera_from_world
            views.append(poses[keyframe_id])
            normalized.append(keyframe.normalized[keypoint])
            index.append(len(pairs))
        pairs.append((landmark, feature))
    if not pairs:
        return
    start = editor.map.landmarks.points_world[editor.map.landmarks.rows(np.array([landmark for landmark, _ in pairs]))]
    points, errors = refine_points(np.stack(views), np.stack(normalized), np.array(index), start)
    worst = np.zeros(len(pairs))
    np.maximum.at(worst, index, editor.map.camera.focal * errors)
    touched: set[int] = set()
    for row in np.flatnonzero(worst < WORST_OF_MANY * config.max_reprojection_px).tolist():
        landmark, feature = pairs[row]
        present = int(other.landmark_ids[feature])
        if landmark in touched or present in touched:
            continue  # its observations are no longer those that were looked at
        touched.update({landmark, present} - {NO_LANDMARK})
        kept = _merge(editor, landmark, other, feature)
        if kept is not None:
            editor.place(kept, points[row])


def _merge(editor: MapEditor, landmark: int, other: MapKeyframe, feature: int) -> int | None:
    """A keypoint of `other` sees the landmark: observe it, or fuse it with the one the keypoint sees; returns the landmark that is left."""
    present = int(other.landmark_ids[feature])
    if landmark not in editor.observers:  # fused away a moment ago
        return None
    if present == NO_LANDMARK:
        editor.observe(landmark, other.id, feature)
        return landmark
    keep, drop = sorted((landmark, present), key=lambda i: (-len(editor.observers.get(i, ())), i))
    editor.fuse(keep, drop)
    return keep
