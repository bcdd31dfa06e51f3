"""The whole system: four stages wired in one thread, frame by frame, deterministic."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import ThegraConfig
from thegra_core.errors import InputError
from thegra_core.features.protocols import Extractor, Matcher
from thegra_core.features.registry import make_extractor, make_matcher
from thegra_core.features.turning import TurningMatcher, turned_features
from thegra_core.geometry.camera import CameraModel
from thegra_core.map.map import Map
from thegra_core.mapping.mapper import Mapper
from thegra_core.messages import (
    Features,
    Frame,
    FrameRecord,
    MapSummary,
    MapUpdate,
    Revisit,
    Run,
    Shutter,
    ShutterState,
    Snapshot,
    TrackingResult,
    TrackingState,
)
from thegra_core.optimization.solver import BundleSolver
from thegra_core.preprocessing.chain import Chain
from thegra_core.preprocessing.shutter import ShutterDetector
from thegra_core.snapshots import SnapshotKeeper
from thegra_core.tracking.fixed_pattern import FixedPatternMask
from thegra_core.tracking.stage import TrackingOutput, TrackingStage

FloatArray = NDArray[np.float64]
_NO_POSE = (TrackingState.INITIALIZING, TrackingState.LOST, TrackingState.RELOCALIZING)
BACKWARD_FRAMES = 3
"""Backward stamps in a row that are refused before time is believed to have been set back."""


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
        solver: Makes the full adjustments after loops and merges, see `Mapper`.

    Raises:
        WeightsError: If the configured networks' weights are not there.
    """

    def __init__(
        self, camera: CameraModel, config: ThegraConfig, extractor: Extractor | None = None, matcher: Matcher | None = None, solver: BundleSolver | None = None
    ) -> None:
        self._camera = camera
        self._chain = Chain(config.preprocessing)
        self._shutter = ShutterDetector(config.preprocessing.shutter)
        self._fixed_pattern = FixedPatternMask()
        self._masks = config.tracking.mask_fixed_pattern
        self._extractor = extractor if extractor is not None else make_extractor(config.extractor)
        self._matcher = TurningMatcher(matcher if matcher is not None else make_matcher(config.matcher, config.extractor))
        self._rotations = config.loop.rotations
        self._turns = 0
        self._tracking = TrackingStage(camera, config, self._matcher)
        self._mapper = Mapper(camera, config, self._matcher, solver)
        self._frames: list[_Placed] = []
        self._last_stamp_ns: int | None = None
        self._backward, self._backward_ns = 0, None  # type: int, int | None
        self._bad: Counter[str] = Counter()
        self._revisits: list[Revisit] = []
        self._closures: list[tuple[int, int]] = []
        self._snapshots = SnapshotKeeper()
        self._view: Callable[[], Snapshot] | None = None
        self._stage_ms: dict[str, float] = {}
        self._first_keyframe_id = 0

    def process(self, frame: Frame) -> TrackingResult:
        """One frame through all stages; never raises for what an image holds. Bad frames are counted and change nothing."""
        begin = time.perf_counter()
        self._stage_ms = {}
        self._view = None
        trouble = self._trouble(frame)
        if trouble:
            self._bad[trouble] += 1
            state = TrackingState.INITIALIZING if self._tracking.map_id < 0 else TrackingState.LOST
            output = TrackingOutput(TrackingResult(frame.stamp_ns, state, reason=trouble))
        else:
            self._last_stamp_ns, self._backward = frame.stamp_ns, 0
            with self._timed("shutter"):
                shutter = self._shutter.update(frame)
            self._note_closure(shutter)
            if shutter.recalibrated:
                self._chain.reset()
                self._fixed_pattern.forget()
            if shutter.shutter is Shutter.JUST_OPENED:
                self._tracking.reopen()
            output = self._tracking.hold(frame.stamp_ns, shutter.reason) if shutter.shutter is Shutter.CLOSED else self._see(frame)
        self._stage_ms["total"] = 1e3 * (time.perf_counter() - begin)
        result = replace(output.result, stage_ms=dict(self._stage_ms))
        self._record(frame.index, result, output.provisional, bad=bool(trouble))
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
        update = self._mapper.load(path)
        self._tracking.resume(update)
        self._first_keyframe_id = 1 + max(m.id for m in update.new_keyframes)

    def save_map(self, path: Path) -> None:
        """Write the map with most keyframes to one file, in whatever state tracking is.

        Raises:
            InputError: If there is no map yet, or the file cannot be written.
        """
        if not self._mapper.map_ids:
            raise InputError(f"there is no map yet that could be written to {path}")
        self._mapper.save(max(self._mapper.map_ids, key=lambda i: (len(self._mapper.map(i).keyframes), -i)), path)

    def snapshot(self) -> Snapshot | None:
        """Image, keypoints and tracks of the last frame; None if it was bad or the shutter was closed."""
        return self._view() if self._view is not None else None

    def map_size(self) -> tuple[int, int]:
        """Keyframes and landmarks of the map being tracked."""
        if self._tracking.map_id < 0:
            return 0, 0
        current = self._mapper.map(self._tracking.map_id)
        return len(current.keyframes), len(current.landmarks)

    def current_map(self) -> MapSummary | None:
        """A copy of what the map being tracked holds; None before the first map."""
        return self._mapper.summary(self._tracking.map_id) if self._tracking.map_id >= 0 else None

    def finish(self, progress: Callable[[str], None] | None = None) -> Run:
        """Full bundle adjustment, late localisation of frames without a pose, and the account of the run."""
        say = progress or (lambda _: None)
        unproven = self._tracking.drop_unproven()
        if unproven is not None:
            self._drop(unproven)
        say("full bundle adjustment")
        for map_id in self._mapper.map_ids if not self.localization_only else ():
            update = self._mapper.finish(map_id)
            if map_id == self._tracking.map_id:
                self._tracking.apply(update)
        say("placing frames that had no pose")
        late = {p.stamp_ns: p for p in self._tracking.localize_afterwards()}
        for row, placed in enumerate(self._frames):
            found = late.get(placed.result.stamp_ns)
            if found is not None and placed.may_be_placed:
                self._frames[row] = replace(
                    placed, map_id=found.map_id, reference_id=found.reference_id, reference_from_camera=found.reference_from_camera, afterwards=True
                )
        maps = {map_id: self._mapper.map(map_id) for map_id in self._mapper.map_ids}
        by_stamp = {(map_id, k.stamp_ns): k.id for map_id, m in maps.items() for k in m.keyframes.values() if k.id >= self._first_keyframe_id}
        records = tuple(self._final(placed, maps, by_stamp) for placed in self._frames)
        counts = Counter(r.map_id for r in records if r.world_from_camera is not None)
        return Run(
            frames=records,
            maps=tuple(self._mapper.summary(i) for i in self._mapper.map_ids),
            main_map_id=max(counts, key=lambda i: (counts[i], -i)) if counts else -1,
            shutter_closures_ns=tuple(self._closures),
            losses=self._tracking.losses,
            loops=self._mapper.loops,
            merges=self._mapper.merges,
            revisits=tuple(self._revisits),
            relocalizations=self._tracking.relocalizations,
            bad_frames=dict(self._bad),
            snapshots=self._snapshots.kept(),
        )

    # ---- steps ----------------------------------------------------------------------------------------------------------------------

    def _see(self, frame: Frame) -> TrackingOutput:
        with self._timed("preprocessing"):
            image = self._chain(frame.image, frame.stamp_ns)
        with self._timed("extraction"):
            features = self._features(image, frame.stamp_ns, self._turns)
        reference = self._tracking.reference_features
        with self._timed("matching"):
            matches = self._matcher.match(features, reference) if reference is not None else None
            if reference is not None and matches is not None and self._masks:
                matches = self._fixed_pattern.learn(features, reference, matches)
        with self._timed("tracking"):
            output = self._tracking.process(features, matches, self._otherwise(image, frame.stamp_ns))
        if output.found_turned is not None:
            features = output.found_turned
            self._turns = features.turns
        if output.dropped_map_id is not None:
            self._drop(output.dropped_map_id)
        with self._timed("mapping"):
            if output.initial_map is not None:
                self._tracking.apply(self._mapper.initialize(output.initial_map))
            elif output.keyframe is not None:
                update = self._mapper.insert(output.keyframe)
                self._tracking.apply(update)
                self._follow(update)
        self._view = lambda: _snapshot(frame, image, features, output, reference)
        self._snapshots.offer(frame.index, self._view)
        return output

    def _features(self, image: NDArray[np.uint8], stamp_ns: int, turns: int) -> Features:
        return self._fixed_pattern.apply(turned_features(image, stamp_ns, turns, self._extractor))

    def _otherwise(self, image: NDArray[np.uint8], stamp_ns: int) -> Iterator[Features]:
        """The features of the other orientations, each found when it is asked for."""
        for degrees in self._rotations:
            yield self._features(image, stamp_ns, (self._turns + degrees // 90) % 4)

    def _trouble(self, frame: Frame) -> str:
        """What is wrong with a frame, or an empty string."""
        width, height = self._camera.image_size
        if frame.image.ndim != 2 or frame.image.shape != (height, width):
            return "image size differs from the camera's"
        if frame.image.dtype.kind == "f" and not np.all(np.isfinite(frame.image)):
            return "image holds NaN or infinity"
        if self._last_stamp_ns is not None and frame.stamp_ns == self._last_stamp_ns:
            return "stamp repeats"
        if self._last_stamp_ns is not None and frame.stamp_ns < self._last_stamp_ns and not self._new_epoch(frame.stamp_ns):
            return "stamp goes backwards"
        return ""

    def _new_epoch(self, stamp_ns: int) -> bool:
        """Whether enough backward stamps in a row ascend among themselves: then the clock was set, or one stamp was wrong, and time goes on from here."""
        self._backward = self._backward + 1 if self._backward_ns is not None and stamp_ns > self._backward_ns else 1
        self._backward_ns = stamp_ns
        return self._backward > BACKWARD_FRAMES

    def _note_closure(self, shutter: ShutterState) -> None:
        if shutter.shutter is Shutter.JUST_OPENED and self._frames and self._frames[-1].result.state is not TrackingState.HOLD:
            self._closures.append((self._frames[-1].result.stamp_ns, shutter.stamp_ns))  # frames are missing instead of repeated
        elif shutter.shutter is Shutter.CLOSED:
            if self._closures and self._frames and self._frames[-1].result.state is TrackingState.HOLD:
                self._closures[-1] = (self._closures[-1][0], shutter.stamp_ns)
            else:
                self._closures.append((shutter.stamp_ns, shutter.stamp_ns))

    def _record(self, index: int, result: TrackingResult, provisional: TrackingResult | None, bad: bool) -> None:
        placed = provisional or result
        if placed.state is not TrackingState.TRACKING or placed.world_from_camera is None:
            self._frames.append(_Placed(result, index, bad=bad))
            return
        map_id = placed.map_id if placed.map_id in self._mapper.map_ids else self._tracking.map_id  # its map may just have become part of another
        reference = self._mapper.map(map_id).keyframes[placed.reference_id]
        relative = np.eye(4) if placed.is_keyframe else reference.camera_from_world @ placed.world_from_camera
        self._frames.append(_Placed(result, index, map_id, placed.reference_id, relative, afterwards=provisional is not None))

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
        self._mapper.drop(map_id)
        self._frames = [_Placed(p.result, p.index, bad=p.bad) if p.map_id == map_id else p for p in self._frames]

    @staticmethod
    def _final(placed: _Placed, maps: dict[int, Map], keyframe_by_stamp: dict[tuple[int, int], int]) -> FrameRecord:
        """A frame carried by the final map; frames that became keyframes of a first map after their time have that keyframe's pose."""
        if placed.reference_from_camera is not None:
            pose = maps[placed.map_id].keyframes[placed.reference_id].world_from_camera @ placed.reference_from_camera
            return FrameRecord(placed.index, placed.result, pose, placed.map_id, placed.afterwards)
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
