"""The whole system: four stages wired frame by frame; in one thread, deterministic, or with mapping beside it in a process of its own."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import ThegraConfig
from thegra_core.errors import MappingError
from thegra_core.features.front_end import DetectAndFollow, DetectEach
from thegra_core.features.protocols import Extractor, FrontEnd, Matcher, Wanted
from thegra_core.features.registry import make_extractor, make_frame_matcher, make_matcher, make_tracking_matchers
from thegra_core.features.tracks import shared_tracks
from thegra_core.features.turning import TurnableExtractor
from thegra_core.geometry.camera import CameraModel
from thegra_core.map.map import Map, summarize
from thegra_core.mapping.mapper import Mapper
from thegra_core.mapping.service import InlineMapping, MappingService
from thegra_core.messages import (
    Features,
    Frame,
    FrameRecord,
    MapSummary,
    MapUpdate,
    Matches,
    Revisit,
    Run,
    Shutter,
    ShutterState,
    Snapshot,
    TrackingResult,
    TrackingState,
)
from thegra_core.optimization.solver import BundleSolver
from thegra_core.preprocessing.stage import Prepared, PreprocessingStage
from thegra_core.process import Usage
from thegra_core.snapshots import SnapshotKeeper
from thegra_core.tracking.fixed_pattern import FixedPatternMask
from thegra_core.tracking.stage import TrackingOutput, TrackingStage

FloatArray = NDArray[np.float64]
logger = logging.getLogger(__name__)
PATIENCE_S = 0.03
"""How long a frame whose points see too few landmarks waits for those of keyframes that have just been made: as long as it takes to detect more points."""
_NO_POSE = (TrackingState.INITIALIZING, TrackingState.LOST, TrackingState.RELOCALIZING)


@dataclass(frozen=True, slots=True)
class _Placed:
    """Where a frame is: relative to a keyframe, so that the final map carries it."""

    result: TrackingResult
    index: int
    map_id: int = -1
    reference_id: int = -1
    reference_from_camera: FloatArray | None = None
    afterwards: bool = False
    bad: bool = False

    def scaled(self, scale: float, map_id: int) -> _Placed:
        """The same in a map whose unit is smaller by `scale`."""
        assert self.reference_from_camera is not None
        relative = self.reference_from_camera.copy()
        relative[:3, 3] *= scale
        return replace(self, reference_from_camera=relative, map_id=map_id)

    @property
    def may_be_placed(self) -> bool:
        """A good frame that had no pose at its time."""
        return not self.bad and self.reference_from_camera is None and self.result.state in _NO_POSE


class Slam:
    """Frames in, poses out; `finish` gives the account of the run.

    Args:
        extractor, matcher: Instead of those that `config.extractor` and `config.matcher` would make.
        keep_records: Remember every frame for `finish`. A live stream has no end and needs only the last one.
        mapping: Where the map is made, of the same camera and configuration, without a map; this system's to close. By default in the same thread. With a
            `MappingProcess` `process` never waits for it, and what becomes of a run depends on the machine.
        solver: Makes the full adjustments after loops and merges, see `Mapper`; not asked where `mapping` is given.

    Raises:
        WeightsError: If the configured networks' weights are not there.
    """

    def __init__(
        self,
        camera: CameraModel,
        config: ThegraConfig,
        extractor: Extractor | None = None,
        matcher: Matcher | None = None,
        *,
        keep_records: bool = True,
        mapping: MappingService | None = None,
        solver: BundleSolver | None = None,
    ) -> None:
        self._camera = camera
        self._preprocessing = PreprocessingStage(config.preprocessing, camera.image_size)
        self._fixed_pattern = FixedPatternMask()
        self._masks = config.tracking.mask_fixed_pattern
        self._extractor = TurnableExtractor(extractor if extractor is not None else make_extractor(config.extractor))
        configured = matcher if matcher is not None else make_matcher(config.matcher, config.extractor)
        self._matcher, self._thorough = make_tracking_matchers(config, configured)
        self._front_end: FrontEnd = DetectEach(self._extractor)
        if config.flow.enabled:
            self._front_end = DetectAndFollow(self._extractor, config.flow)
        self._mapping = mapping if mapping is not None else InlineMapping(Mapper(camera, config, make_frame_matcher(config, configured), solver))
        self._tracking = TrackingStage(camera, config, self._matcher, self._mapping.submit, self._thorough)
        self._frames: list[_Placed] = []
        self._keep_records = keep_records
        self._bad: Counter[str] = Counter()
        self._revisits: list[Revisit] = []
        self._closures: list[tuple[int, int]] = []
        self._snapshots = SnapshotKeeper()
        self._view: Callable[[], Snapshot] | None = None
        self._stage_ms: dict[str, float] = {}
        self._first_keyframe_id = 0

    def warm_up(self) -> None:
        """Let everything that is made at its first use be made, and wait for the process of mapping: a live stream waits for nothing."""
        width, height = self._camera.image_size
        noise = np.random.default_rng(0).integers(0, 255, (height, width), np.uint8)
        self._front_end.follow(self._preprocessing.warm_up(noise), 0)
        features = self._front_end.detect()
        self._front_end.forget()
        self._camera.undistort(features.keypoints.astype(np.float64))
        for matcher in (self._matcher, *self._thorough):
            matcher.match(features, features)
        self._mapping.usage()

    def usage(self) -> Usage:
        """What processes beside this one have used."""
        return self._mapping.usage()

    def close(self) -> None:
        """End what runs beside this process; nothing else can be called afterwards."""
        self._mapping.close()

    def process(self, frame: Frame) -> TrackingResult:
        """One frame through all stages; never raises for what an image holds. Bad frames are counted and change nothing."""
        return self.track(self.prepare(frame))

    def prepare(self, frame: Frame) -> Prepared:
        """The first stage alone. It depends on no other: frames may be prepared by a thread of their own, in the order in which they are tracked."""
        return self._preprocessing.process(frame)

    def track(self, prepared: Prepared) -> TrackingResult:
        """A prepared frame through all stages but the first, see `process`."""
        begin = time.perf_counter()
        frame, shutter = prepared.frame, prepared.shutter
        self._stage_ms = dict(prepared.stage_ms)
        self._view = None
        if shutter is None:
            self._bad[prepared.trouble] += 1
            state = TrackingState.INITIALIZING if self._tracking.map_id < 0 else TrackingState.LOST
            output = TrackingOutput(TrackingResult(frame.stamp_ns, state, reason=prepared.trouble))
        else:
            self._note_closure(shutter)
            if shutter.recalibrated:
                self._fixed_pattern.forget()
            if shutter.shutter is Shutter.JUST_OPENED:
                self._tracking.reopen()
            output = self._hold(frame, shutter) if prepared.image is None else self._see(frame, prepared.image)
        self._record(frame.index, output.result, output.provisional, bad=shutter is None)
        if shutter is not None:
            with self._timed("mapping"):
                self._take_updates()  # after the frame has its place beside a keyframe, which updates may move
            self._place_beside_itself(output.provisional or output.result)
        self._stage_ms["total"] = sum(prepared.stage_ms.values()) + 1e3 * (time.perf_counter() - begin)
        result = replace(output.result, stage_ms=dict(self._stage_ms))
        self._frames[-1] = replace(self._frames[-1], result=result)
        return result

    @property
    def localization_only(self) -> bool:
        """Whether the map stays as it is: no keyframe joins it, and no new map is begun."""
        return self._tracking.localization_only

    @localization_only.setter
    def localization_only(self, only: bool) -> None:
        self._tracking.localization_only = only

    def load_map(self, path: Path) -> None:
        """Begin in a kept map instead of an empty one: the frames to come are sought in all of it. Call it before the first frame.

        Raises:
            InputError: If the file is not there, not whole, or of another version, camera or extractor.
        """
        update = self._mapping.load(path)
        self._tracking.resume(update)
        self._first_keyframe_id = 1 + max(m.id for m in update.new_keyframes)

    def save_map(self, path: Path) -> None:
        """Write the map with most keyframes to one file, in whatever state tracking is.

        Raises:
            InputError: If there is no map yet, or the file cannot be written.
        """
        self._mapping.save(path)

    def snapshot(self) -> Snapshot | None:
        """Image, keypoints and tracks of the last frame; None if it was bad or the shutter was closed."""
        return self._view() if self._view is not None else None

    def map_size(self) -> tuple[int, int]:
        """Keyframes and landmarks of the map being tracked."""
        current = self._tracking.map
        return (len(current.keyframes), len(current.landmarks)) if current is not None else (0, 0)

    def current_map(self) -> MapSummary | None:
        """A copy of what the map being tracked holds; None before the first map."""
        return summarize(self._tracking.map) if self._tracking.map is not None else None

    def finish(self, progress: Callable[[str], None] | None = None) -> Run:
        """Full bundle adjustment, late localisation of frames without a pose, and the account of the run."""
        say = progress or (lambda _: None)
        unproven = self._tracking.drop_unproven()
        if unproven is not None:
            self._drop(unproven)
        say("full bundle adjustment")
        maps, (loops, merges) = self._finished_maps()
        say("placing frames that had no pose")
        late = {p.stamp_ns: p for p in self._tracking.localize_afterwards()}
        for row, placed in enumerate(self._frames):
            found = late.get(placed.result.stamp_ns)
            if found is not None and placed.may_be_placed:
                self._frames[row] = replace(
                    placed, map_id=found.map_id, reference_id=found.reference_id, reference_from_camera=found.reference_from_camera, afterwards=True
                )
        by_stamp = {(map_id, k.stamp_ns): k.id for map_id, m in maps.items() for k in m.keyframes.values() if k.id >= self._first_keyframe_id}
        records = tuple(self._final(placed, maps, by_stamp) for placed in self._frames)
        counts = Counter(r.map_id for r in records if r.world_from_camera is not None)
        return Run(
            frames=records,
            maps=tuple(summarize(current) for current in maps.values()),
            main_map_id=max(counts, key=lambda i: (counts[i], -i)) if counts else -1,
            shutter_closures_ns=tuple(self._closures),
            losses=self._tracking.losses,
            loops=loops,
            merges=merges,
            revisits=tuple(self._revisits),
            relocalizations=self._tracking.relocalizations,
            bad_frames=dict(self._bad),
            snapshots=self._snapshots.kept(),
        )

    # ---- steps ----------------------------------------------------------------------------------------------------------------------

    def _hold(self, frame: Frame, shutter: ShutterState) -> TrackingOutput:
        with self._timed("mapping"):
            self._take_updates()
        return self._tracking.hold(frame.stamp_ns, shutter.reason)

    def _see(self, frame: Frame, image: NDArray[np.uint8]) -> TrackingOutput:
        if self._extractor.turns != self._tracking.turns:  # nothing that was found in images turned otherwise is followed on
            self._extractor.turns = self._tracking.turns
            self._front_end.forget()
        with self._timed("flow"):
            followed = self._front_end.follow(image, frame.stamp_ns, self._tracking.expects_detection(frame.stamp_ns))
        with self._timed("mapping"):
            self._take_updates()  # of keyframes that came before: this frame needs their landmarks
            for keyframe in self._tracking.catch_up():
                self._mapping.insert(keyframe)
        reference = self._tracking.reference_features
        features, output = self._front(image, frame.stamp_ns, followed, reference)
        if output.dropped_map_id is not None:
            self._drop(output.dropped_map_id)
        with self._timed("mapping"):
            if output.initial_map is not None:
                self._mapping.initialize(output.initial_map)
            elif output.keyframe is not None:
                self._mapping.insert(output.keyframe)
        self._view = lambda: _snapshot(frame, image, features, output, reference)
        self._snapshots.offer(frame.index, self._view)
        return output

    def _turned(self, image: NDArray[np.uint8], stamp_ns: int, turns: int) -> Features:
        """The features of the image turned by so many quarter turns."""
        return self._fixed_pattern.apply(self._extractor.turned(image, stamp_ns, turns - self._extractor.turns))

    def _front(
        self, image: NDArray[np.uint8], stamp_ns: int, followed: Features | None, reference: Features | None
    ) -> tuple[Features, TrackingOutput]:
        """Features of the image and what tracking made of them: of those followed, if there are any and they suffice, else of what is detected."""
        wanted = Wanted.MORE
        if followed is not None:
            features = self._fixed_pattern.apply(followed)
            with self._timed("matching"):
                matches = self._unmasked(features, reference, shared_tracks(features, reference)) if reference is not None else None
            with self._timed("tracking"):
                output = self._tracking.process_followed(features, matches)
            end = time.perf_counter() + PATIENCE_S
            while self._tracking.lacks_landmarks and self._landmarks_come(end - time.perf_counter()):
                with self._timed("tracking"):
                    output = self._tracking.process_followed(features, matches)
            if isinstance(output, TrackingOutput):
                return features, output
            wanted = output
        with self._timed("extraction"):
            features = self._fixed_pattern.apply(self._front_end.detect(wanted))
        with self._timed("matching"):
            matches = self._unmasked(features, reference, self._matcher.match(features, reference)) if reference is not None else None
        with self._timed("tracking"):
            output = self._tracking.process(features, matches, partial(self._turned, image, stamp_ns))
        return (output.found_turned if output.found_turned is not None else features), output

    def _unmasked(self, features: Features, reference: Features, matches: Matches) -> Matches:
        return self._fixed_pattern.learn(features, reference, matches) if self._masks else matches

    def _finished_maps(self) -> tuple[dict[int, Map], tuple[int, int]]:
        """Maps by id, and how many loops and merges there were; what tracking knows of its map where mapping has failed."""
        try:
            for update in self._mapping.finish() if not self.localization_only else ():
                self._take(update)
            return {current.map_id: current for current in self._mapping.maps()}, self._mapping.counts()
        except MappingError as error:
            logger.warning("the map is left as tracking knows it: %s", error)
            known = self._tracking.map
            return ({known.map_id: known} if known is not None and known.keyframes else {}), (0, 0)

    def _landmarks_come(self, patience_s: float) -> bool:
        with self._timed("mapping"):
            return self._take_updates(max(patience_s, 0.0))

    def _take_updates(self, patience_s: float = 0.0) -> bool:
        """Whether there were any."""
        updates = self._mapping.updates(patience_s)
        for update in updates:
            self._take(update)
        return bool(updates)

    def _take(self, update: MapUpdate) -> None:
        self._tracking.apply(update)
        self._follow(update)

    def _note_closure(self, shutter: ShutterState) -> None:
        if shutter.shutter is Shutter.JUST_OPENED and self._frames and self._frames[-1].result.state is not TrackingState.HOLD:
            self._closures.append((self._frames[-1].result.stamp_ns, shutter.stamp_ns))  # frames are missing instead of repeated
        elif shutter.shutter is Shutter.CLOSED:
            if self._closures and self._frames and self._frames[-1].result.state is TrackingState.HOLD:
                self._closures[-1] = (self._closures[-1][0], shutter.stamp_ns)
            else:
                self._closures.append((shutter.stamp_ns, shutter.stamp_ns))

    def _record(self, index: int, result: TrackingResult, provisional: TrackingResult | None, bad: bool) -> None:
        if not self._keep_records:
            self._frames.clear()
        placed = provisional or result
        if placed.state is not TrackingState.TRACKING or placed.world_from_camera is None:
            self._frames.append(_Placed(result, index, bad=bad))
            return
        reference_id, relative = self._tracking.relative_to_reference(placed)
        self._frames.append(_Placed(result, index, self._tracking.map_id, reference_id, relative, afterwards=provisional is not None))

    def _place_beside_itself(self, result: TrackingResult) -> None:
        """The frame recorded last, where it is a keyframe that the map knows by now."""
        current, placed = self._tracking.map, self._frames[-1]
        if result.is_keyframe and current is not None and placed.map_id == current.map_id and result.reference_id in current.keyframes:
            self._frames[-1] = replace(placed, reference_id=result.reference_id, reference_from_camera=np.eye(4))

    def _follow(self, update: MapUpdate) -> None:
        """Frames keep their place when their keyframe leaves the map, when a loop changes the scale there, or their map becomes part of another."""
        self._revisits.extend(update.revisits)
        if update.removed_keyframes:
            self._inherit(update)
        absorbed = update.absorbed
        if not update.scales and absorbed is None:
            return
        for row, placed in enumerate(self._frames):
            if placed.reference_from_camera is None:
                continue
            if absorbed is not None and placed.map_id == absorbed.map_id:
                self._frames[row] = placed.scaled(absorbed.scale, update.map_id)
            elif placed.map_id == update.map_id:
                self._frames[row] = placed.scaled(update.scales.get(placed.reference_id, 1.0), update.map_id)

    def _inherit(self, update: MapUpdate) -> None:
        removed = {r.id: r for r in update.removed_keyframes}
        by_stamp = {r.stamp_ns: r for r in removed.values() if r.id >= self._first_keyframe_id}
        map_id = update.map_id if update.absorbed is None else update.absorbed.map_id
        for row, placed in enumerate(self._frames):
            gone = removed.get(placed.reference_id)
            if placed.reference_from_camera is not None and gone is not None:
                self._frames[row] = replace(placed, reference_id=gone.heir_id, reference_from_camera=gone.heir_from_removed @ placed.reference_from_camera)
            elif placed.may_be_placed and placed.result.stamp_ns in by_stamp:  # a frame of before the first map, which was this keyframe
                gone = by_stamp[placed.result.stamp_ns]
                self._frames[row] = replace(placed, map_id=map_id, reference_id=gone.heir_id, reference_from_camera=gone.heir_from_removed, afterwards=True)

    def _drop(self, map_id: int) -> None:
        """Forget a map and the places of frames in it."""
        self._mapping.drop(map_id)
        self._frames = [_Placed(p.result, p.index, bad=p.bad) if p.map_id == map_id else p for p in self._frames]

    @staticmethod
    def _final(placed: _Placed, maps: dict[int, Map], keyframe_by_stamp: dict[tuple[int, int], int]) -> FrameRecord:
        """A frame carried by the final map; frames that are keyframes, also of a first map after their time, have that keyframe's pose."""
        known = maps[placed.map_id].keyframes if placed.map_id in maps else {}
        itself = keyframe_by_stamp.get((placed.map_id, placed.result.stamp_ns))
        if placed.reference_from_camera is not None and (itself is not None or placed.reference_id in known):
            beside = known[placed.reference_id].world_from_camera @ placed.reference_from_camera if itself is None else known[itself].world_from_camera
            return FrameRecord(placed.index, placed.result, beside, placed.map_id, placed.afterwards)
        if placed.may_be_placed:
            for map_id, current in maps.items():
                keyframe_id = keyframe_by_stamp.get((map_id, placed.result.stamp_ns))
                if keyframe_id is not None:
                    return FrameRecord(placed.index, placed.result, current.keyframes[keyframe_id].world_from_camera, map_id, True)
        return FrameRecord(placed.index, placed.result, None, -1)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            self._stage_ms[stage] = self._stage_ms.get(stage, 0.0) + 1e3 * (time.perf_counter() - begin)


def _snapshot(frame: Frame, image: NDArray[np.uint8], features: Features, output: TrackingOutput, reference: Features | None) -> Snapshot:
    tracked = output.landmark_ids >= 0 if output.landmark_ids is not None else np.zeros(len(features), dtype=bool)
    previous = np.full((len(features), 2), np.nan, dtype=np.float32)
    if output.matches is not None and reference is not None and output.matches.reference_stamp_ns == reference.stamp_ns:
        previous[output.matches.indices[:, 0]] = reference.keypoints[output.matches.indices[:, 1]]
    return Snapshot(frame.stamp_ns, frame.index, output.result.state, image, features.keypoints, tracked, previous)
