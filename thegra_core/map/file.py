"""A map as named arrays and back: what a map file holds of it. Exact: a map that is read again is the map that was written."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry.camera import CameraModel, DistortionModel
from thegra_core.map.archive import Arrays
from thegra_core.map.editor import MapEditor
from thegra_core.map.landmarks import COLUMNS
from thegra_core.messages import Features, Keyframe, LandmarkArrays

IntArray = NDArray[np.int64]

_FEATURES = ("keypoints", "scores", "descriptors")


def map_arrays(editor: MapEditor) -> Arrays:
    """Keyframes, landmarks, their counts and the covisibility graph; per-keypoint arrays of all keyframes joined, `keyframes/offsets` (K + 1,) between them."""
    current = editor.map
    keyframes = [current.keyframes[i] for i in sorted(current.keyframes)]
    landmarks = current.landmarks.get(current.landmarks.alive_ids())
    ids = landmarks.ids.tolist()
    edges = [(i, other, shared) for i in sorted(current.covisibility) for other, shared in current.covisibility[i]]
    arrays: Arrays = {
        "keyframes/ids": np.array([k.id for k in keyframes], dtype=np.int64),
        "keyframes/stamps_ns": np.array([k.stamp_ns for k in keyframes], dtype=np.int64),
        "keyframes/world_from_camera": np.array([k.world_from_camera for k in keyframes]).reshape(-1, 4, 4),
        "keyframes/reference_ids": np.array([k.reference_id for k in keyframes], dtype=np.int64),
        "keyframes/turns": np.array([k.features.turns for k in keyframes], dtype=np.int64),
        "keyframes/offsets": offsets([len(k.features) for k in keyframes]),
        "keyframes/landmark_ids": np.concatenate([k.landmark_ids for k in keyframes]),
        "landmarks/first_keyframe": np.array([editor.first_keyframe[i] for i in ids], dtype=np.int64),
        "landmarks/visible": np.array([editor.visible[i] for i in ids], dtype=np.int64),
        "landmarks/found": np.array([editor.found[i] for i in ids], dtype=np.int64),
        "landmarks/next": np.array([editor.next_landmark], dtype=np.int64),
        "covisibility": np.array(edges, dtype=np.int64).reshape(-1, 3),
    }
    arrays |= {f"keyframes/{name}": np.concatenate([getattr(k.features, name) for k in keyframes]) for name in _FEATURES}
    arrays |= {f"landmarks/{name}": getattr(landmarks, name) for name in COLUMNS}
    return arrays


def restore_map(arrays: Arrays, map_id: int, camera: CameraModel, extractor: str, covisibility_threshold: int) -> MapEditor:
    """The map of `map_arrays`. All of it counts as changed, so that the first update gives replicas the whole map."""
    edges: dict[int, list[tuple[int, int]]] = {}
    for keyframe_id, other, shared in arrays["covisibility"].tolist():
        edges.setdefault(keyframe_id, []).append((other, shared))
    bounds = arrays["keyframes/offsets"].tolist()
    turns = arrays.get("keyframes/turns", np.zeros(len(bounds), np.int64))  # files of before images could be turned have none
    keyframes = []
    for row, keyframe_id in enumerate(arrays["keyframes/ids"].tolist()):
        mine = slice(bounds[row], bounds[row + 1])
        stamp_ns = int(arrays["keyframes/stamps_ns"][row])
        parts = {name: arrays[f"keyframes/{name}"][mine] for name in _FEATURES}
        features = Features(stamp_ns, image_size=camera.image_size, extractor=extractor, turns=int(turns[row]), **parts)
        pose, seen = arrays["keyframes/world_from_camera"][row], arrays["keyframes/landmark_ids"][mine]
        keyframes.append(Keyframe(keyframe_id, stamp_ns, pose, features, seen, int(arrays["keyframes/reference_ids"][row]), map_id))
    landmarks = LandmarkArrays(**{name: arrays[f"landmarks/{name}"] for name in COLUMNS})
    return MapEditor.restored(
        map_id, camera, covisibility_threshold, keyframes, landmarks,
        {i: tuple(edge) for i, edge in edges.items()},
        counts=(arrays["landmarks/first_keyframe"], arrays["landmarks/visible"], arrays["landmarks/found"]),
        next_landmark=int(arrays["landmarks/next"][0]),
    )  # fmt: skip


def offsets(lengths: list[int]) -> IntArray:
    """Where each of several joined arrays begins, and where the last one ends (N + 1,)."""
    return np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)]).astype(np.int64)


def camera_header(camera: CameraModel) -> dict[str, Any]:
    """A camera as JSON, exact."""
    return {
        "model": camera.model.value,
        "image_size": list(camera.image_size),
        "matrix": camera.matrix.tolist(),
        "distortion": camera.distortion.tolist(),
    }


def camera_of(header: dict[str, Any]) -> CameraModel:
    """The camera of `camera_header`."""
    width, height = header["image_size"]
    return CameraModel(np.array(header["matrix"]), np.array(header["distortion"]), DistortionModel(header["model"]), (int(width), int(height)), name="map")
