"""New landmarks looked for in keyframes that no network matched: longer tracks for the price of a projection (ORB-SLAM3's SearchInNeighbors)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import TrackingConfig
from thegra_core.map.editor import MapEditor
from thegra_core.map.projection import match_by_projection, visible_landmarks
from thegra_core.messages import NO_LANDMARK


def propagate(editor: MapEditor, landmark_ids: NDArray[np.int64], keyframe_ids: list[int], config: TrackingConfig) -> int:
    """Let each keyframe observe the landmarks (L,) that project near one of its free keypoints of like descriptor; returns the observations added.

    The visibility tests and the search are those of tracking's second stage, at its narrow radius.
    """
    editor.refresh()
    added = 0
    for keyframe_id in keyframe_ids:
        keyframe = editor.map.keyframes[keyframe_id]
        unseen = landmark_ids[[keyframe_id not in editor.observers.get(i, {}) for i in landmark_ids.tolist()]]
        unseen = unseen[editor.map.landmarks.rows(unseen) >= 0]
        visible = visible_landmarks(editor.map.landmarks, unseen, keyframe.camera_from_world, editor.map.camera, config)
        free = (keyframe.landmark_ids == NO_LANDMARK) & np.isfinite(keyframe.normalized).all(axis=1)
        found, keypoints = match_by_projection(
            visible, keyframe.features.keypoints, keyframe.features.descriptors, free,
            config.search_radius_px, config.min_descriptor_similarity, config.descriptor_ratio,
        )  # fmt: skip
        for landmark, feature in zip(visible.ids[found].tolist(), keypoints.tolist(), strict=True):
            editor.observe(landmark, keyframe_id, feature)
        added += len(found)
    return added
