"""One map as both mapping (its owner) and tracking (a replica) hold it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry import poses
from thegra_core.geometry.camera import CameraModel
from thegra_core.map.landmarks import LandmarkStore
from thegra_core.messages import Features, Keyframe, MapSummary, MapUpdate

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(slots=True)
class MapKeyframe:
    """A keyframe in a map: what never changes (features and their undistorted coordinates) and what does (pose, landmark ids)."""

    id: int
    stamp_ns: int
    world_from_camera: FloatArray
    features: Features
    normalized: FloatArray
    landmark_ids: IntArray
    reference_id: int

    @property
    def camera_from_world(self) -> FloatArray:
        return poses.inverse(self.world_from_camera)

    @property
    def center(self) -> FloatArray:
        """Position (3,) in the world."""
        return np.asarray(self.world_from_camera[:3, 3])


def make_keyframes(messages: Sequence[Keyframe], camera: CameraModel) -> list[MapKeyframe]:
    """The map's form of keyframe messages; keypoints whose pixel the camera model cannot undistort get NaN coordinates."""
    if not messages:
        return []
    normalized = camera.undistort(np.concatenate([m.features.keypoints for m in messages]).astype(np.float64))
    parts = np.split(normalized, np.cumsum([len(m.features) for m in messages])[:-1])
    return [
        MapKeyframe(
            id=message.id,
            stamp_ns=message.stamp_ns,
            world_from_camera=message.world_from_camera.copy(),
            features=message.features,
            normalized=part,
            landmark_ids=message.landmark_ids.copy(),
            reference_id=message.reference_id,
        )
        for message, part in zip(messages, parts, strict=True)
    ]


class Map:
    """Keyframes, landmarks and the covisibility graph of one map.

    `covisibility[id]` lists (keyframe id, shared landmarks) of the connected keyframes, most shared first.
    """

    def __init__(self, map_id: int, camera: CameraModel) -> None:
        self.map_id = map_id
        self.camera = camera
        self.version = 0
        self.keyframes: dict[int, MapKeyframe] = {}
        self.landmarks = LandmarkStore()
        self.covisibility: dict[int, tuple[tuple[int, int], ...]] = {}

    def neighbours(self, keyframe_id: int, count: int) -> list[int]:
        """Ids of at most `count` connected keyframes, most shared landmarks first."""
        return [other for other, _ in self.covisibility.get(keyframe_id, ())[:count]]

    def local_keyframes(self, keyframe_id: int, count: int) -> list[int]:
        """The keyframe, its neighbours, then theirs, at most `count` in all."""
        local = [keyframe_id, *self.neighbours(keyframe_id, count - 1)]
        for first in tuple(local[1:]):
            if len(local) >= count:
                break
            for second in self.neighbours(first, 5):
                if second not in local and len(local) < count:
                    local.append(second)
        return local

    def landmark_ids_of(self, keyframe_ids: list[int]) -> IntArray:
        """Ascending ids of the living landmarks that any of the keyframes observes."""
        if not keyframe_ids:
            return np.empty(0, np.int64)
        ids = np.unique(np.concatenate([self.keyframes[i].landmark_ids for i in keyframe_ids]))
        return ids[self.landmarks.rows(ids) >= 0]

    def median_depth(self, keyframe_id: int, world_from_camera: FloatArray | None = None) -> float:
        """Median depth (map units) of a keyframe's landmarks, seen from it or from another pose; NaN if it observes none in front."""
        keyframe = self.keyframes[keyframe_id]
        rows = self.landmarks.rows(keyframe.landmark_ids)
        points = self.landmarks.points_world[rows[rows >= 0]] if len(self.landmarks) else np.empty((0, 3))
        camera_from_world = poses.inverse(world_from_camera) if world_from_camera is not None else keyframe.camera_from_world
        z = poses.apply(camera_from_world, points)[:, 2] if len(points) else np.empty(0)
        z = z[z > 0]
        return float(np.median(z)) if len(z) else float("nan")

    def apply(self, update: MapUpdate) -> None:
        """Make this replica equal to the map that sent the update. Updates must come in the order of their versions."""
        for removed in update.removed_keyframes:
            self.keyframes.pop(removed.id, None)
            self.covisibility.pop(removed.id, None)
        self.keyframes.update((keyframe.id, keyframe) for keyframe in make_keyframes(update.new_keyframes, self.camera))
        for state in update.keyframes:
            keyframe = self.keyframes[state.id]
            keyframe.world_from_camera = state.world_from_camera
            keyframe.landmark_ids = state.landmark_ids
        if update.landmarks is not None:
            self.landmarks.put(update.landmarks)
        self.landmarks.remove(update.removed_landmark_ids)
        self.covisibility.update(update.covisibility)
        self.version = update.version


def summarize(current: Map) -> MapSummary:
    """A copy of what a map holds, for outputs."""
    keyframes = [current.keyframes[i] for i in sorted(current.keyframes)]
    landmarks = current.landmarks.get(current.landmarks.alive_ids()) if len(current.landmarks) else None
    return MapSummary(
        map_id=current.map_id,
        keyframe_stamps_ns=np.array([k.stamp_ns for k in keyframes], dtype=np.int64),
        keyframe_poses=np.array([k.world_from_camera for k in keyframes]).reshape(-1, 4, 4),
        points_world=landmarks.points_world if landmarks is not None else np.empty((0, 3)),
        point_scores=landmarks.scores if landmarks is not None else np.empty(0, np.float32),
    )
