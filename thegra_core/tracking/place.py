"""Where tracking is: its replica of a map, and what it knows there."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thegra_core.map.map import Map
from thegra_core.messages import Features, Keyframe, MapUpdate
from thegra_core.places.index import PlaceIndex
from thegra_core.tracking.followed import TrackLandmarks
from thegra_core.tracking.motion import MotionModel
from thegra_core.tracking.visibility import VisibilityTally

FloatArray = NDArray[np.float64]


@dataclass(slots=True)
class Place:
    """Where tracking is: a replica of a map and of its places, keyframes of it, and what has been seen since the last one.

    resumed: the map was made in another run, so that its stamps say nothing about this one. pending: keyframes that mapping has not answered yet.
    awaited_since_ns: stamp after which frames came while mapping made the map, until they have been looked at. turns: quarter turns counter-clockwise by which
    images are turned before features are looked for in them, so that they lie as the map's first one does. unadjusted_id: the keyframe by which the camera was
    found again, until the map has been adjusted around it; -1 if there is none. due_ns: stamp of the last frame that is to be a keyframe by its followed points.
    ratios: how much of the last keyframe the last two frames since have seen, see `tracked_ratio`.
    """

    map: Map
    places: PlaceIndex
    reference_id: int
    last_keyframe_id: int
    probation: int
    lost_frames: int = 0
    search_frames: int = 0
    resumed: bool = False
    motion: MotionModel = field(default_factory=MotionModel)
    seen: VisibilityTally = field(default_factory=VisibilityTally)
    tracks: TrackLandmarks = field(default_factory=TrackLandmarks)
    pending: dict[int, Keyframe] = field(default_factory=dict)
    awaited_since_ns: int | None = None
    turns: int = 0
    unadjusted_id: int = -1
    due_ns: int = -1
    ratios: tuple[float, ...] = ()

    @property
    def begun(self) -> bool:
        """Whether mapping has made the first keyframes of the map."""
        return self.reference_id in self.map.keyframes

    @property
    def reference(self) -> Features:
        return self.map.keyframes[self.reference_id].features

    @property
    def last_keyframe_pose(self) -> FloatArray:
        return self.pending[max(self.pending)].world_from_camera if self.pending else self.map.keyframes[self.last_keyframe_id].world_from_camera

    def take(self, update: MapUpdate) -> None:
        self.map.apply(update)
        heirs = {removed.id: removed.heir_id for removed in update.removed_keyframes}
        self.reference_id, self.last_keyframe_id = (heirs.get(i, i) for i in (self.reference_id, self.last_keyframe_id))
        if update.adjusted_id >= self.unadjusted_id:
            self.unadjusted_id = -1
        for removed in update.removed_keyframes:
            self.places.remove(removed.id)
        for message in update.new_keyframes:
            self.pending.pop(message.id, None)
        for message in update.new_keyframes:
            self.places.add(message.id, message.features)
        for state in update.keyframes:
            if state.id == self.last_keyframe_id:
                self.tracks.take(self.map.keyframes[state.id].features, state.landmark_ids)

    def predict(self, stamp_ns: int) -> FloatArray | None:
        return self.motion.predict(stamp_ns) if self.lost_frames == 0 else None
