"""The tracking stage: features and map updates in, poses, keyframes and first maps out."""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import ThegraConfig
from thegra_core.features.protocols import Matcher
from thegra_core.geometry import poses
from thegra_core.geometry.camera import CameraModel
from thegra_core.map.map import Map
from thegra_core.messages import Features, InitialMap, Keyframe, MapUpdate, Matches, TrackingResult, TrackingState, VisibilityCounts
from thegra_core.tracking.initializer import Initializer
from thegra_core.tracking.keyframe_policy import needs_keyframe
from thegra_core.tracking.motion import MotionModel
from thegra_core.tracking.relocalizer import last_keyframes, nearest_in_time, relocalize
from thegra_core.tracking.tracker import Localization, best_reference, localize

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class TrackingOutput:
    """What tracking says about a frame: the result, and what mapping has to do about it, if anything.

    landmark_ids (N,) per keypoint and the matches used are for viewers; None where there are none.
    """

    result: TrackingResult
    keyframe: Keyframe | None = None
    initial_map: InitialMap | None = None
    landmark_ids: IntArray | None = None
    matches: Matches | None = None


@dataclass(frozen=True, slots=True)
class LateLocalization:
    """A frame without a pose at its time, placed in a map afterwards."""

    stamp_ns: int
    map_id: int
    reference_id: int
    reference_from_camera: FloatArray


class TrackingStage:
    """State of tracking: a replica of the current map, the reference keyframe, the motion model, and the search for a first map.

    Call `process` (or `hold`) once a frame, hand what it returns to mapping, and `apply` every update that mapping sends back.
    """

    def __init__(self, camera: CameraModel, config: ThegraConfig, matcher: Matcher) -> None:
        self._camera = camera
        self._config = config
        self._matcher = matcher
        self._initializer = Initializer(camera, config, matcher)
        self._motion = MotionModel()
        self._map: Map | None = None
        self._reference_id = -1
        self._last_keyframe_id = -1
        self._next_keyframe_id = 0
        self._next_map_id = 0
        self._lost_frames = 0
        self._visible: list[IntArray] = []
        self._found: list[IntArray] = []
        self._unplaced: deque[Features] = deque(maxlen=config.relocalization.remembered_frames)
        self.losses = 0
        self.relocalizations = 0

    @property
    def reference_features(self) -> Features | None:
        """What the front end should match the next frame to."""
        return self._initializer.reference_features if self._map is None else self._map.keyframes[self._reference_id].features

    @property
    def map_id(self) -> int:
        return self._map.map_id if self._map is not None else -1

    def process(self, features: Features, matches: Matches | None) -> TrackingOutput:
        """Track one frame; `matches` are to `reference_features` (None: not matched yet)."""
        if self._map is None:
            return self._start(features, matches)
        if matches is None or matches.reference_stamp_ns != self._map.keyframes[self._reference_id].stamp_ns:
            matches = self._matcher.match(features, self._map.keyframes[self._reference_id].features)
        predicted = self._motion.predict(features.stamp_ns) if self._lost_frames == 0 else None
        found = localize(self._map, features, self._reference_id, matches, predicted, self._config)
        if isinstance(found, str):
            return self._recover(features, found)
        return self._accept(features, found, matches)

    def hold(self, stamp_ns: int, reason: str) -> TrackingOutput:
        """A frame that shows nothing (shutter closed): the pose is predicted, and marked as that."""
        predicted = self._motion.predict(stamp_ns) if self._lost_frames == 0 else None
        return TrackingOutput(TrackingResult(stamp_ns, TrackingState.HOLD, predicted, map_id=self.map_id, reference_id=self._reference_id, reason=reason))

    def apply(self, update: MapUpdate) -> None:
        """Bring the replica up to date; the newest keyframe becomes the reference and the motion model follows its correction."""
        if self._map is None or self._map.map_id != update.map_id:
            self._map = Map(update.map_id, self._camera)
        before = {m.id: m.world_from_camera for m in update.new_keyframes}
        self._map.apply(update)
        if before:
            newest = max(before)
            self._reference_id = self._last_keyframe_id = newest
            self._motion.move(self._map.keyframes[newest].world_from_camera @ poses.inverse(before[newest]))

    def localize_afterwards(self) -> list[LateLocalization]:
        """Place frames that had no pose at their time in the current map, by the keyframes nearest in time."""
        placed: list[LateLocalization] = []
        if self._map is None:
            return placed
        keyframe_stamps = {k.stamp_ns for k in self._map.keyframes.values()}
        for features in self._unplaced:
            if features.stamp_ns in keyframe_stamps:
                continue
            candidates = nearest_in_time(self._map, features.stamp_ns, 2)
            found = relocalize(self._map, features, candidates, self._matcher, self._config, self._config.relocalization.min_inliers)
            if found is not None:
                reference = self._map.keyframes[found[1]]
                relative = reference.camera_from_world @ found[0].world_from_camera
                placed.append(LateLocalization(features.stamp_ns, self._map.map_id, found[1], relative))
        return placed

    # ---- steps ----------------------------------------------------------------------------------------------------------------------

    def _start(self, features: Features, matches: Matches | None) -> TrackingOutput:
        initial = self._initializer.add(features, matches, self._next_map_id, self._next_keyframe_id)
        if isinstance(initial, str):
            self._unplaced.append(features)
            result = TrackingResult(features.stamp_ns, TrackingState.INITIALIZING, keypoints=len(features), matches=len(matches or ()), reason=initial)
            return TrackingOutput(result, matches=matches)
        return self._begin_map(features, initial)

    def _begin_map(self, features: Features, initial: InitialMap) -> TrackingOutput:
        self._initializer.reset()
        self._next_map_id += 1
        self._next_keyframe_id += len(initial.keyframes)
        self._lost_frames = 0
        self._visible, self._found = [], []
        self._motion.reset()
        for keyframe in initial.keyframes[-2:]:
            self._motion.update(keyframe.stamp_ns, keyframe.world_from_camera)
        last = initial.keyframes[-1]
        seen = int((last.landmark_ids >= 0).sum())
        result = TrackingResult(
            features.stamp_ns, TrackingState.TRACKING, last.world_from_camera, np.eye(6) * 1e-6, self._motion.twist(), len(features), seen, seen, seen,
            is_keyframe=True, map_id=initial.map_id, reference_id=last.id, reason="first map",
        )  # fmt: skip
        return TrackingOutput(result, initial_map=initial, landmark_ids=last.landmark_ids, matches=last.reference_matches)

    def _accept(self, features: Features, found: Localization, matches: Matches) -> TrackingOutput:
        assert self._map is not None
        if self._lost_frames:
            self._lost_frames = 0
            self.relocalizations += 1
            self._initializer.reset()
            self._motion.reset()
        world_from_camera = found.world_from_camera
        self._motion.update(features.stamp_ns, world_from_camera)
        self._visible.append(found.visible_ids)
        self._found.append(found.landmark_ids[found.landmark_ids >= 0])
        matched_to = self._reference_id
        keyframe = self._as_keyframe(features, found, matches)
        if keyframe is None:
            local = self._map.local_keyframes(self._reference_id, self._config.tracking.local_keyframes)
            self._reference_id = best_reference(self._map, found.landmark_ids, local)
        result = TrackingResult(
            features.stamp_ns, TrackingState.TRACKING, world_from_camera, found.covariance, self._motion.twist(), len(features), found.matches,
            found.inliers, len(found.visible_ids), keyframe is not None, self._map.map_id, keyframe.id if keyframe is not None else matched_to,
        )  # fmt: skip
        return TrackingOutput(result, keyframe, landmark_ids=found.landmark_ids, matches=matches)

    def _as_keyframe(self, features: Features, found: Localization, matches: Matches) -> Keyframe | None:
        """The frame as a keyframe message if one is due."""
        assert self._map is not None
        last = self._map.keyframes[self._last_keyframe_id]
        reference = self._map.keyframes[self._reference_id]
        tracked_ratio = found.inliers / max(int((self._map.landmarks.rows(reference.landmark_ids) >= 0).sum()), 1)
        depth = self._map.median_depth(self._reference_id, found.world_from_camera)
        reason = needs_keyframe(last.world_from_camera, found.world_from_camera, depth, tracked_ratio, self._config.keyframe)
        if not reason:
            return None
        visible, visible_counts = np.unique(np.concatenate(self._visible), return_counts=True)
        found_ids, found_counts = np.unique(np.concatenate(self._found), return_counts=True)
        counts = np.zeros(len(visible), dtype=np.int64)
        counts[np.searchsorted(visible, found_ids)] = found_counts
        self._visible, self._found = [], []
        keyframe = Keyframe(
            self._next_keyframe_id, features.stamp_ns, found.world_from_camera, features, found.landmark_ids, self._reference_id, self._map.map_id,
            matches, VisibilityCounts(visible, visible_counts.astype(np.int64), counts),
        )  # fmt: skip
        self._next_keyframe_id += 1
        return keyframe

    def _recover(self, features: Features, reason: str) -> TrackingOutput:
        """Tracking failed: the last keyframes, then a new map beside the old one."""
        assert self._map is not None
        settings = self._config.relocalization
        candidates = last_keyframes(self._map, self._reference_id, settings.keyframes)
        least = self._config.tracking.min_inliers if self._lost_frames == 0 else settings.min_inliers
        found = relocalize(self._map, features, candidates, self._matcher, self._config, least)
        if found is not None:
            self._reference_id = found[1]
            return self._accept(features, found[0], found[2])
        if self._lost_frames == 0:
            self.losses += 1
            logger.warning("lost at %.3f s: %s", features.stamp_ns / 1e9, reason)
        self._lost_frames += 1
        if self._lost_frames >= settings.new_map_after_frames:
            initial = self._initializer.add(features, None, self._next_map_id, self._next_keyframe_id)
            if not isinstance(initial, str):
                logger.info("map %d continues after %d frames lost", initial.map_id, self._lost_frames)
                return self._begin_map(features, initial)
            reason = f"{reason}; a new map waits: {initial}"
        self._unplaced.append(features)
        result = TrackingResult(features.stamp_ns, TrackingState.LOST, keypoints=len(features), map_id=self._map.map_id, reason=reason)
        return TrackingOutput(result)


def with_times(result: TrackingResult, stage_ms: dict[str, float]) -> TrackingResult:
    """The result with the stages' milliseconds."""
    return replace(result, stage_ms=stage_ms)
