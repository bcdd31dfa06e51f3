"""The tracking stage: features and map updates in, poses, keyframes and first maps out."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import ThegraConfig
from thegra_core.features.protocols import Matcher, Wanted
from thegra_core.geometry import poses
from thegra_core.geometry.camera import CameraModel
from thegra_core.geometry.similarity import Similarity
from thegra_core.map.map import Map
from thegra_core.map.orientation import lie_alike
from thegra_core.messages import (
    NO_LANDMARK,
    Absorbed,
    Features,
    InitialMap,
    Keyframe,
    MapUpdate,
    Matches,
    TrackingResult,
    TrackingState,
)
from thegra_core.places.index import PlaceIndex
from thegra_core.process import Submit, call_now
from thegra_core.tracking.followed import NotPlaced, localize_followed
from thegra_core.tracking.initializer import Initializer
from thegra_core.tracking.keyframe_policy import foreseen, needs_keyframe, tracked_ratio
from thegra_core.tracking.place import Place
from thegra_core.tracking.relocalizer import doubt_nearby, doubt_of, evidence, nearest_in_time, relocalize
from thegra_core.tracking.seeking import Seeker
from thegra_core.tracking.tracker import FrameView, Localization, best_reference, localize
from thegra_core.tracking.turning import FoundTurned, Turned, turn_back

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class TrackingOutput:
    """What tracking says about a frame: the result, and what mapping has to do about it, if anything.

    While a new map is on probation nothing is claimed: `result` has no pose, and `provisional` is the result that holds if the map stands.
    `dropped_map_id` names a map that did not stand. landmark_ids (N,) per keypoint and the matches used are for viewers; None where there are none.
    found_turned: the frame's features of another orientation, by which it was found; landmark_ids and matches are theirs.
    """

    result: TrackingResult
    keyframe: Keyframe | None = None
    initial_map: InitialMap | None = None
    landmark_ids: IntArray | None = None
    matches: Matches | None = None
    provisional: TrackingResult | None = None
    dropped_map_id: int | None = None
    found_turned: Features | None = None


@dataclass(frozen=True, slots=True)
class LateLocalization:
    """A frame without a pose at its time, placed in a map afterwards."""

    stamp_ns: int
    map_id: int
    reference_id: int
    reference_from_camera: FloatArray


class TrackingStage:
    """State of tracking: the place in the current map, the map before it while a new one is on probation, and the search for a first map.

    Call `process` (or `hold`) once a frame, hand what it returns to mapping, and `apply` every update that mapping sends back. What takes long at the start
    of a map is done by `submit`. Where the matcher finds too little to place a frame, those of `thorough` are asked in turn, slower ones that find more.
    """

    def __init__(self, camera: CameraModel, config: ThegraConfig, matcher: Matcher, submit: Submit = call_now, thorough: Sequence[Matcher] = ()) -> None:
        self._camera = camera
        self._config = config
        self._matcher = matcher
        self._seeker = Seeker(matcher, thorough, config)
        self._initializer = Initializer(camera, config, matcher, submit)
        self._place: Place | None = None
        self._before: Place | None = None
        self._first_keyframe_id = self._next_keyframe_id = 0
        self._next_map_id = 0
        self._unplaced: deque[Features] = deque(maxlen=config.relocalization.remembered_frames)
        self.localization_only = False
        self.lacks_landmarks = False
        self.losses = 0
        self.relocalizations = 0

    @property
    def reference_features(self) -> Features | None:
        """What the front end should match the next frame to."""
        if self._place is None:
            return self._initializer.reference_features
        return self._place.reference if self._place.begun else None

    @property
    def turns(self) -> int:
        """Quarter turns counter-clockwise by which the next image had better be turned before features are looked for in it."""
        return self._place.turns if self._place is not None else 0

    @property
    def map(self) -> Map | None:
        """The replica of the current map; read it and change nothing."""
        return self._place.map if self._place is not None else None

    @property
    def map_id(self) -> int:
        return self._place.map.map_id if self._place is not None else -1

    def catch_up(self) -> list[Keyframe]:
        """Call it before each frame: keyframes that are due from the time in which mapping made a new map, for it to insert.

        Keypoints that were followed since then see landmarks that the map holds, but fewer with each frame, and no new ones until there are keyframes. As many
        frames as may wait for mapping are placed, evenly spread to the newest.
        """
        place = self._place
        if place is None or not place.begun or place.awaited_since_ns is None:
            return []
        missed = [f for f in self._unplaced if f.stamp_ns > place.awaited_since_ns and f.track_ids is not None]
        place.awaited_since_ns = None
        most = self._config.keyframe.most_pending
        rows = np.unique(np.linspace(0, len(missed) - 1, most + 1).round().astype(int)[1:]) if missed else ()
        due = (self._placed_late(place, missed[row]) for row in rows)
        return [keyframe for keyframe in due if keyframe is not None]

    def process(self, features: Features, matches: Matches | None, turned: Turned | None = None) -> TrackingOutput:
        """Track one frame; `matches` are to `reference_features` (None: not matched yet). `turned` is asked for its features of other orientations."""
        place = self._place
        if place is None:
            return self._start(features, matches)
        if not place.begun:
            return self._wait_for_map(place, features)
        if matches is None or matches.reference_stamp_ns != place.reference.stamp_ns:
            matches = self._matcher.match(features, place.reference)
        found = localize(place.map, features, place.reference_id, {place.reference_id: matches}, place.predict(features.stamp_ns), self._config)
        if not isinstance(found, str):
            found = (doubt_of if place.lost_frames else doubt_nearby)(place.map, found, place.reference_id, self._config) or found
        if isinstance(found, str):
            return self._recover(place, features, matches, found, turned)
        if self._may_turn_back(place, features, found) and turned is not None:
            back = turn_back(place.map, place.reference_id, found, place.turns, turned, [self._matcher, *self._seeker.thorough][-1], self._config)
            if back is not None:
                return self._go_on_turned(place, back)
        return self._accept(place, features, found, matches)

    def expects_detection(self, stamp_ns: int) -> bool:
        """Whether a frame of that time, followed keypoints or not, will most likely have to be detected in: where the camera is sought, or a keyframe is due if it
        goes on as it did."""
        place = self._place
        if place is None or not place.begun:
            return False
        predicted = place.predict(stamp_ns)
        if predicted is None:
            return place.lost_frames > 0
        return self._may_insert(place) and self._needs_keyframe(place, predicted, foreseen(place.ratios))

    def process_followed(self, features: Features, matches: Matches | None) -> TrackingOutput | Wanted:
        """Track one frame by keypoints that were followed to it; `matches` as for `process`.

        Instead of an answer, what `process` should get of the same image: more features if a keyframe is due or these give no pose, other ones if these are
        wrong. `lacks_landmarks` says whether these give no pose while mapping has yet to tell what a keyframe brought: it may be as well to wait for that.
        """
        place = self._place
        self.lacks_landmarks = False
        if place is None:
            return self._start(features, matches)
        if not place.begun:
            return self._wait_for_map(place, features)
        if place.lost_frames:
            return Wanted.MORE
        assert features.track_ids is not None
        landmark_ids = place.tracks.of(features.track_ids)
        predicted = place.predict(features.stamp_ns) if not place.search_frames else None
        found = localize_followed(place.map, features, landmark_ids, predicted, self._config)
        if isinstance(found, NotPlaced):
            logger.debug("followed keypoints at %.3f s: %s", features.stamp_ns / 1e9, found.reason)
            self.lacks_landmarks = bool(place.pending) and not found.misled
            return Wanted.ANEW if found.misled else Wanted.MORE
        if self._keyframe_due(place, features, found):
            place.due_ns = features.stamp_ns
            return Wanted.MORE
        return self._accept_followed(place, features, found, matches)

    def hold(self, stamp_ns: int, reason: str) -> TrackingOutput:
        """A frame that shows nothing (shutter closed): the pose is predicted, and marked as that; not for longer than a closure can last."""
        place = self._place
        if place is None or place.probation or place.motion.since(stamp_ns) > self._config.preprocessing.shutter.longest_s:
            return TrackingOutput(TrackingResult(stamp_ns, TrackingState.HOLD, reason=reason))
        predicted = place.predict(stamp_ns)
        covariance = place.motion.predicted_covariance(stamp_ns) if predicted is not None else None
        result = TrackingResult(
            stamp_ns, TrackingState.HOLD, predicted, covariance, map_id=self.map_id, reference_id=place.reference_id, reason=reason
        )  # fmt: skip
        return TrackingOutput(result)

    def resume(self, update: MapUpdate, next_map_id: int = 0, next_keyframe_id: int = 0) -> None:
        """Take up a map that was kept, before the first frame: the frames to come are sought in all of it.

        New maps and keyframes get ids that the map does not hold, from `next_map_id` and `next_keyframe_id` on: mapping may have other maps beside it.
        """
        newest = max(m.id for m in update.new_keyframes)
        place = Place(Map(update.map_id, self._camera), self._place_index(), newest, newest, probation=0, lost_frames=1, resumed=True)
        place.search_frames = self._config.relocalization.search_frames
        self._place = place
        self._next_map_id = max(update.map_id + 1, next_map_id)
        self._first_keyframe_id = self._next_keyframe_id = max(newest + 1, next_keyframe_id)
        self.apply(update)

    def reopen(self) -> None:
        """The camera sees again after a time that it did not: until it is found, or `search_frames` have passed, it counts as sought for, not as lost."""
        if self._place is not None and self._place.lost_frames == 0:
            self._place.search_frames = self._config.relocalization.search_frames

    def apply(self, update: MapUpdate) -> None:
        """Bring the replica up to date; a new keyframe becomes the reference unless images are turned otherwise by then, and the motion model follows the reference's correction.

        Updates of a map that was dropped in the meantime are ignored. Where the current map has become part of another, tracking goes on in that.
        """
        if update.absorbed is not None:
            self._move_into(update, update.absorbed)
            return
        for place in (self._place, self._before):
            if place is not None and place.map.map_id == update.map_id:
                break
        else:
            return
        before = {m.id: m.world_from_camera for m in update.new_keyframes}
        newest = max(before, default=place.reference_id)
        if newest in place.map.keyframes:
            before[newest] = place.map.keyframes[newest].world_from_camera.copy()
        place.take(update)
        if update.new_keyframes:
            place.last_keyframe_id = newest
            if place.map.keyframes[newest].features.turns == place.turns:  # what comes after a turn does not look like what came before
                place.reference_id = newest
            place.tracks.take(place.map.keyframes[newest].features, place.map.keyframes[newest].landmark_ids)
        if newest in before and newest in place.map.keyframes:
            corrected = Similarity(place.map.keyframes[newest].world_from_camera, update.scales.get(newest, 1.0))
            moved = corrected @ Similarity(before[newest]).inverse()
            place.motion.move(moved)
            if update.scales:
                place.pending = {i: replace(k, world_from_camera=(moved @ Similarity(k.world_from_camera)).rigid) for i, k in place.pending.items()}

    def _move_into(self, update: MapUpdate, absorbed: Absorbed) -> None:
        """Go on in the map that has taken in another, where a place is in one of the two; that they fit proves the current one."""
        for place in (self._place, self._before):
            if place is None or place.map.map_id not in (absorbed.map_id, update.map_id):
                continue
            moves = place.map.map_id == absorbed.map_id
            place.map, place.places = Map(update.map_id, self._camera), self._place_index()
            place.take(update)
            if not moves:
                continue
            place.motion.move(Similarity(absorbed.rigid, absorbed.scale))
            place.reference_id = place.last_keyframe_id = newest = max(m.id for m in update.new_keyframes)
            place.tracks.replace(place.map.keyframes[newest].features, place.map.keyframes[newest].landmark_ids)
            place.unadjusted_id, place.pending = -1, {}
            place.seen.forget()
            if place is self._place:
                place.probation, self._before = 0, None

    def relative_to_reference(self, result: TrackingResult) -> tuple[int, FloatArray]:
        """A keyframe of the current map and reference_from_camera (4, 4) of a result that has a pose, before updates that came since; the first keyframes of a map
        that mapping has not made yet are their own."""
        assert self._place is not None and result.world_from_camera is not None
        keyframes = self._place.map.keyframes
        if not self._place.begun:
            return result.reference_id, np.eye(4)
        reference_id = result.reference_id if result.reference_id in keyframes else self._place.reference_id
        return reference_id, keyframes[reference_id].camera_from_world @ result.world_from_camera

    def drop_unproven(self) -> int | None:
        """At the end of a run: give up a map that is still on probation; its id, or None."""
        return self._drop() if self._place is not None and self._place.probation else None

    def localize_afterwards(self) -> list[LateLocalization]:
        """Place frames that had no pose at their time in the current map, by the keyframes nearest in time."""
        placed: list[LateLocalization] = []
        if self._place is None:
            return placed
        current = self._place.map
        keyframe_stamps = {k.stamp_ns for k in current.keyframes.values() if k.id >= self._first_keyframe_id}
        for features in self._unplaced:
            if features.stamp_ns in keyframe_stamps:
                continue
            candidates = self._place.places.query(features, 2) if self._place.resumed else nearest_in_time(current, features.stamp_ns, 2)
            found = relocalize(current, features, candidates, self._matcher, self._config, nearby=False)
            if found is not None:
                relative = current.keyframes[found[1]].camera_from_world @ found[0].world_from_camera
                placed.append(LateLocalization(features.stamp_ns, current.map_id, found[1], relative))
        return placed

    # ---- steps ----------------------------------------------------------------------------------------------------------------------

    def _start(self, features: Features, matches: Matches | None) -> TrackingOutput:
        initial = self._initializer.add(features, matches, self._next_map_id, self._next_keyframe_id)
        if isinstance(initial, str):
            self._unplaced.append(features)
            result = TrackingResult(features.stamp_ns, TrackingState.INITIALIZING, keypoints=len(features), matches=len(matches or ()), reason=initial)
            return TrackingOutput(result, matches=matches)
        return self._begin_map(features, initial)

    def _placed_late(self, place: Place, features: Features) -> Keyframe | None:
        """A frame that came before its map did, as a keyframe if it finds a place and one is due."""
        assert features.track_ids is not None
        predicted = place.predict(features.stamp_ns)
        found = localize_followed(place.map, features, place.tracks.of(features.track_ids), predicted, self._config)
        if isinstance(found, NotPlaced):
            return None
        self._note(place, features, found)
        place.tracks.replace(features, found.landmark_ids)
        return self._as_keyframe(place, features, found, self._matcher.match(features, place.reference))

    def _wait_for_map(self, place: Place, features: Features) -> TrackingOutput:
        """Mapping has not made the new map yet."""
        self._unplaced.append(features)
        state = TrackingState.INITIALIZING if self._before is None else TrackingState.LOST
        return TrackingOutput(TrackingResult(features.stamp_ns, state, keypoints=len(features), map_id=place.map.map_id, reason="a new map is being made"))

    def _begin_map(self, features: Features, initial: InitialMap) -> TrackingOutput:
        last = initial.keyframes[-1]
        place = Place(Map(initial.map_id, self._camera), self._place_index(), last.id, last.id, self._config.initialization.probation_frames)
        for keyframe in initial.keyframes[-2:]:
            place.motion.update(keyframe.stamp_ns, keyframe.world_from_camera)
        place.awaited_since_ns = last.stamp_ns
        place.turns = last.features.turns
        self._before, self._place = self._place, place
        self._next_map_id += 1
        self._next_keyframe_id += len(initial.keyframes)
        if last.stamp_ns != features.stamp_ns:  # it was solved meanwhile: the frames to come are tracked in it
            return replace(self._wait_for_map(place, features), initial_map=initial)
        keypoints = np.flatnonzero(last.landmark_ids != NO_LANDMARK)
        estimate = FrameView(features, self._camera, self._config).refine(
            poses.inverse(last.world_from_camera), initial.points_world[last.landmark_ids[keypoints]], keypoints, self._config.tracking.chi2_px2
        )
        seen = len(keypoints)
        result = TrackingResult(
            features.stamp_ns, TrackingState.TRACKING, last.world_from_camera, estimate.covariance, place.motion.twist(), len(features), seen, seen, seen,
            is_keyframe=True, map_id=initial.map_id, reference_id=last.id, reason="first map",
        )  # fmt: skip
        return self._claim(place, features, TrackingOutput(result, initial_map=initial, landmark_ids=last.landmark_ids, matches=last.reference_matches))

    def _accept(self, place: Place, features: Features, found: Localization, matches: Matches, sought: bool = False) -> TrackingOutput:
        sought = sought or place.lost_frames > 0
        if place.lost_frames:
            told = "found again at %.3f s in map %d after %d frames: %d landmarks of the most similar keyframe agree, %d should be seen from there"
            logger.info(told, features.stamp_ns / 1e9, place.map.map_id, place.lost_frames, *evidence(place.map, found, place.reference_id, self._config))
            place.lost_frames = 0
            self.relocalizations += 1
            place.motion.reset()
        place.search_frames = 0
        self._note(place, features, found)
        place.tracks.replace(features, found.landmark_ids)
        matched_to = place.reference_id
        keyframe = self._as_keyframe(place, features, found, matches)
        if keyframe is not None and sought:
            place.unadjusted_id = keyframe.id
        if keyframe is None:
            local = place.map.local_keyframes(place.reference_id, self._config.tracking.local_keyframes)
            alike = [i for i in local if lie_alike(place.map.keyframes[i], found.world_from_camera, features.turns)]
            place.reference_id = best_reference(place.map, found.landmark_ids, alike or local)
        result = self._result(place, features, found, keyframe.id if keyframe is not None else matched_to, keyframe is not None)
        return self._claim(place, features, TrackingOutput(result, keyframe, landmark_ids=found.landmark_ids, matches=matches))

    def _accept_followed(self, place: Place, features: Features, found: Localization, matches: Matches | None) -> TrackingOutput:
        place.search_frames = 0
        self._note(place, features, found)
        result = self._result(place, features, found, place.reference_id, is_keyframe=False)
        return self._claim(place, features, TrackingOutput(result, landmark_ids=found.landmark_ids, matches=matches))

    def _note(self, place: Place, features: Features, found: Localization) -> None:
        """A frame was placed: motion goes on from it, and its landmarks were seen."""
        place.probation = max(0, place.probation - 1)
        place.motion.update(features.stamp_ns, found.world_from_camera, found.covariance)
        if not self.localization_only:
            place.seen.note(found.visible_ids, found.landmark_ids[found.landmark_ids >= 0])

    @staticmethod
    def _result(place: Place, features: Features, found: Localization, reference_id: int, is_keyframe: bool) -> TrackingResult:
        return TrackingResult(
            features.stamp_ns, TrackingState.TRACKING, found.world_from_camera, found.covariance, place.motion.twist(), len(features), found.matches,
            found.inliers, len(found.visible_ids), is_keyframe, place.map.map_id, reference_id,
        )  # fmt: skip

    def _claim(self, place: Place, features: Features, output: TrackingOutput) -> TrackingOutput:
        """The output as it may be told: a pose only once the map has stood its probation."""
        if place.probation == 0:
            self._initializer.reset()
            self._before = None
            return output
        self._unplaced.append(features)
        state = TrackingState.INITIALIZING if self._before is None else TrackingState.LOST
        reason = f"a first map on probation: {place.probation} more frames must fit it"
        counts = TrackingResult(features.stamp_ns, state, keypoints=len(features), matches=output.result.matches, inliers=output.result.inliers, reason=reason)
        return replace(output, result=counts, provisional=output.result)

    def _as_keyframe(self, place: Place, features: Features, found: Localization, matches: Matches) -> Keyframe | None:
        """The frame as a keyframe message if one is due."""
        if not self._keyframe_due(place, features, found):
            return None
        keyframe = Keyframe(
            self._next_keyframe_id, features.stamp_ns, found.world_from_camera, features, found.landmark_ids, place.reference_id, place.map.map_id,
            matches, place.seen.take(), place.map.version,
        )  # fmt: skip
        self._next_keyframe_id += 1
        place.pending[keyframe.id], place.ratios = keyframe, ()
        return keyframe

    def _may_turn_back(self, place: Place, features: Features, found: Localization) -> bool:
        """Whether a tracked frame is one to be looked for turned: not every one, for that costs an extraction."""
        if not self._config.loop.rotations or place.lost_frames or place.probation:
            return False
        return self.localization_only or self._keyframe_due(place, features, found)

    def _go_on_turned(self, place: Place, found: FoundTurned) -> TrackingOutput:
        """Accept a frame by the features of another orientation; the images to come are turned alike."""
        place.reference_id, place.turns = found.reference_id, found.features.turns
        logger.info("from %.3f s on images are turned by %d degrees", found.features.stamp_ns / 1e9, 90 * place.turns)
        return replace(self._accept(place, found.features, found.localization, found.matches), found_turned=found.features)

    def _keyframe_due(self, place: Place, features: Features, found: Localization) -> bool:
        if not self._may_insert(place):
            return False
        if place.due_ns == features.stamp_ns:
            return True  # by the followed points, and the image was detected in for it
        place.ratios = (*place.ratios[-1:], tracked_ratio(place, features, found.inliers))
        return self._needs_keyframe(place, found.world_from_camera, place.ratios[-1])

    def _may_insert(self, place: Place) -> bool:
        """Whether mapping may have one more keyframe: what hangs on one that was placed by little would bend the map before that can be set right."""
        return not self.localization_only and len(place.pending) < self._config.keyframe.most_pending and place.unadjusted_id < 0

    def _needs_keyframe(self, place: Place, world_from_camera: FloatArray, ratio: float) -> bool:
        depth = place.map.median_depth(place.reference_id, world_from_camera)
        return bool(needs_keyframe(place.last_keyframe_pose, world_from_camera, depth, ratio, self._config.keyframe))

    def _recover(self, place: Place, features: Features, matches: Matches, reason: str, turned: Turned | None) -> TrackingOutput:
        """Tracking failed: drop a map on probation; else the last keyframes, then all that look alike, then a new map beside the old one."""
        if place.probation:
            dropped = self._drop()
            logger.info("map %s did not stand its probation: %s", dropped, reason)
            output = self._start(features, None) if self._place is None else self._stay_lost(self._place, features, reason)
            return replace(output, dropped_map_id=dropped)
        found = self._seeker.seek(place, features, matches)
        if found is not None:
            place.reference_id = found[1]
            return self._accept(place, features, found[0], found[2], sought=True)
        rotations = self._config.loop.rotations if turned is not None and place.lost_frames < self._config.relocalization.new_map_after_frames else ()
        for degrees in rotations:
            assert turned is not None
            other = turned((place.turns + degrees // 90) % 4)
            found = self._seeker.seek(place, other, self._matcher.match(other, place.reference))
            if found is not None:
                return self._go_on_turned(place, FoundTurned(other, *found))
        if place.search_frames:
            place.search_frames -= 1
            self._unplaced.append(features)
            result = TrackingResult(features.stamp_ns, TrackingState.RELOCALIZING, keypoints=len(features), map_id=place.map.map_id, reason=reason)
            return TrackingOutput(result)
        return self._stay_lost(place, features, reason)

    def _stay_lost(self, place: Place, features: Features, reason: str) -> TrackingOutput:
        if place.lost_frames == 0:
            self.losses += 1
            logger.warning("lost at %.3f s: %s", features.stamp_ns / 1e9, reason)
        place.lost_frames, place.unadjusted_id = place.lost_frames + 1, -1
        if place.lost_frames >= self._config.relocalization.new_map_after_frames and not self.localization_only:
            initial = self._initializer.add(features, None, self._next_map_id, self._next_keyframe_id)
            if not isinstance(initial, str):
                logger.info("map %d continues after %d frames lost", initial.map_id, place.lost_frames)
                return self._begin_map(features, initial)
            reason = f"{reason}; a new map waits: {initial}"
        self._unplaced.append(features)
        return TrackingOutput(TrackingResult(features.stamp_ns, TrackingState.LOST, keypoints=len(features), map_id=place.map.map_id, reason=reason))

    def _place_index(self) -> PlaceIndex:
        return PlaceIndex(self._config.loop, self._config.seed)

    def _drop(self) -> int:
        """Back to where tracking was before the current map began."""
        assert self._place is not None
        dropped = self._place.map.map_id
        self._place, self._before = self._before, None
        return dropped
