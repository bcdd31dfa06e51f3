"""What a frame sees of a map by its matches to keyframes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from thegra_core.map.map import Map
from thegra_core.messages import Matches

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def inherited_landmarks(current: Map, matched: Mapping[int, Matches], defined: BoolArray) -> tuple[IntArray, IntArray]:
    """Keypoints (M,) of a frame and the landmarks (M,) that they inherit by its matches to keyframes, one to one, the most confident match first.

    defined (N,) bool: the frame's keypoints that may be used.
    """
    keypoints, ids, confidence = [], [], []
    for keyframe_id, matches in matched.items():
        inherited = current.keyframes[keyframe_id].landmark_ids[matches.indices[:, 1]]
        use = (current.landmarks.rows(inherited) >= 0) & defined[matches.indices[:, 0]]
        keypoints.append(matches.indices[use, 0].astype(np.int64))
        ids.append(inherited[use])
        confidence.append(matches.confidence[use])
    all_keypoints, all_ids = np.concatenate(keypoints), np.concatenate(ids)
    order = np.argsort(-np.concatenate(confidence), kind="stable")
    for key in (all_keypoints, all_ids):
        order = order[np.sort(np.unique(key[order], return_index=True)[1])]
    order = order[np.argsort(all_keypoints[order], kind="stable")]
    return all_keypoints[order], all_ids[order]
