"""Tracking while mapping is behind: what changes in maps between a frame's tracking and the answer."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from late_mapping import LateMapping
from synthetic import CAMERA, FakeExtractor, FakeMatcher, loop, room, stamp
from test_slam import CONFIG, ate, frames

from thegra_core.config import ThegraConfig
from thegra_core.geometry.alignment import umeyama
from thegra_core.mapping import culling
from thegra_core.mapping.mapper import Mapper
from thegra_core.mapping.service import InlineMapping
from thegra_core.messages import InitialMap, Keyframe, MapUpdate, TrackingState
from thegra_core.slam import Slam
from thegra_core.tracking import stage
from thegra_core.tracking.seeking import Seeker
from thegra_core.tracking.visibility import MOST_FRAMES, VisibilityTally

ROUND = loop(330, turns=1.0)


def make(path: list[np.ndarray | None], mapping: Callable[[Mapper], InlineMapping], config: ThegraConfig = CONFIG) -> tuple[Slam, dict[int, np.ndarray]]:
    """A system in the room, and the poses that its frames have: those that are taken out show nothing."""
    poses = {stamp(i): pose for i, pose in enumerate(path) if pose is not None}
    matcher = FakeMatcher()
    return Slam(CAMERA, config, FakeExtractor(room(1500), poses), matcher, mapping=mapping(Mapper(CAMERA, config, matcher))), poses


def test_tracking_goes_on_beside_the_heir_of_a_reference_that_is_thinned_out(monkeypatch: pytest.MonkeyPatch) -> None:
    slam, _ = make([*ROUND[:60]], InlineMapping)
    for frame in frames(50):
        slam.process(frame)
    place, mapper = slam._tracking._place, slam._mapping._mapper  # type: ignore[attr-defined]
    assert place is not None
    redundant = sorted(place.map.keyframes)[-3:-1]
    place.reference_id = redundant[0]
    with monkeypatch.context() as patched:
        patched.setattr(culling, "remove_redundant", lambda editor, *_: [editor.remove_keyframe(i) or i for i in redundant])
        mapper._thin(mapper._editors[0], max(place.map.keyframes))
    slam._tracking.apply(mapper._editors[0].take_update())  # without a new keyframe, as the second step of one has it
    assert place.begun
    assert {slam.process(frame).state for frame in frames(10, begin=50)} == {TrackingState.TRACKING}


NEVER_FOUND = CONFIG.model_copy(update={"relocalization": CONFIG.relocalization.model_copy(update={"min_inliers": 2000})})
"""So that a camera that is set down elsewhere makes a second map."""
WALK = loop(110, turns=1.0)
SET_BACK = [*WALK[:35], *WALK[5:11], *WALK[12:40:2]]


class _Held(InlineMapping):
    """Does all at once; from when map 1 has become part of map 0 on its answers are not there for so many looks."""

    def __init__(self, mapper: Mapper, looks: int) -> None:
        super().__init__(mapper)
        self._looks = looks
        self.held = 0

    def insert(self, keyframe: Keyframe) -> None:
        super().insert(keyframe)
        if keyframe.map_id == 1 and self._mapper.map_ids == [0]:
            self.held = self._looks

    def updates(self, patience_s: float = 0.0) -> list[MapUpdate]:
        self.held = max(self.held - 1, 0)
        return [] if self.held else super().updates()

    def drop(self, map_id: int) -> None:
        super().drop(map_id)
        self.held = 0


def test_a_frame_beside_which_maps_merge_is_moved_with_them() -> None:
    slam, _ = make([*SET_BACK], lambda mapper: _Held(mapper, 3), NEVER_FOUND)  # it comes after the next frame has been tracked
    for frame in frames(len(SET_BACK)):
        slam.process(frame)
    run = slam.finish()
    assert (run.merges, len(run.maps)) == (1, 1)
    placed = [(f.world_from_camera[:3, 3], pose[:3, 3]) for f, pose in zip(run.frames, SET_BACK, strict=True) if f.world_from_camera is not None]
    found, true = (np.array(part) for part in zip(*placed, strict=True))
    scale, rotation, translation = umeyama(found[:30], true[:30])  # of map 0
    assert np.linalg.norm(scale * found @ rotation.T + translation - true, axis=1).max() < 0.1, "left in the other world it would be off by the room's size"


def test_a_map_given_up_while_it_becomes_part_of_another() -> None:
    path = SET_BACK
    slam, poses = make([*path], lambda mapper: _Held(mapper, 1000), NEVER_FOUND)
    mapping = slam._mapping
    assert isinstance(mapping, _Held)
    given_up = False
    for frame in frames(len(path)):
        held = mapping.held
        if held:
            poses.pop(frame.stamp_ns)  # it shows nothing: the second map does not stand its probation
        result = slam.process(frame)
        if held:
            given_up, replica, (kept,) = True, slam._tracking.map, mapping.maps()
            assert replica is not None and (replica.map_id, kept.map_id) == (0, 0)
            assert replica.keyframes.keys() == kept.keyframes.keys(), "what the second map has brought is known"
    assert given_up and result.map_id == 0
    slam.finish()


class _Behind(InlineMapping):
    """Busy with the keyframes of map 1 until map 2 begins."""

    def __init__(self, mapper: Mapper) -> None:
        super().__init__(mapper)
        self._kept_back: list[Keyframe] | None = []

    def insert(self, keyframe: Keyframe) -> None:
        if keyframe.map_id == 1 and self._kept_back is not None:
            self._kept_back.append(keyframe)
        else:
            super().insert(keyframe)

    def initialize(self, initial: InitialMap) -> None:
        if initial.map_id == 2:
            kept_back, self._kept_back = self._kept_back or [], None
            for keyframe in kept_back:
                super().insert(keyframe)
        super().initialize(initial)


def test_the_map_before_the_one_on_probation_becomes_part_of_another(monkeypatch: pytest.MonkeyPatch) -> None:
    walk = loop(220, turns=1.0)
    path = [*walk[:70], *walk[10:30], *[None] * 7, *walk[120:123], *[None] * 2, *[walk[22 + i % 6] for i in range(40)]]
    slam, poses = make(path, _Behind)
    seek, failed = Seeker.seek, -1
    monkeypatch.setattr(Seeker, "seek", lambda self, *what: seek(self, *what) if failed >= 0 else None)
    for frame in frames(len(path)):
        if slam._tracking.map_id == 2 and failed < 0 and slam._tracking.map is not None and slam._tracking.map.keyframes:
            failed = frame.index
            poses.pop(frame.stamp_ns, None)  # map 2 does not stand its probation
        slam.process(frame)
    run = slam.finish()
    assert (slam._tracking.map_id, run.merges, [m.map_id for m in run.maps]) == (0, 1, [0])
    tracked = [f for f in run.frames[failed:] if f.result.state is TrackingState.TRACKING]
    assert len(tracked) > 30 and all(f.world_from_camera is not None and f.map_id == 0 for f in tracked)


def test_a_camera_found_again_and_lost_again_before_it_was_adjusted_makes_keyframes() -> None:
    path = [*ROUND[:60], None, *ROUND[64:66], *[None] * 5, *ROUND[200:205], *ROUND[66:150]]
    seen = 0
    slam, _ = make(path, lambda mapper: LateMapping(mapper, lambda name: 30 if name == "insert" and 60 <= seen < 75 else 0))
    for seen, frame in enumerate(frames(len(path))):
        result = slam.process(frame)
        if seen == 75:
            before = slam.map_size()[0]
    assert (result.state, result.map_id) == (TrackingState.TRACKING, 0)
    assert slam.map_size()[0] > before + 10


def test_frames_stamped_like_keyframes_of_a_kept_map_are_placed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, _ = make([*ROUND[:60]], InlineMapping)
    for frame in frames(60):
        first.process(frame)
    first.finish()
    first.save_map(tmp_path / "hall.map")
    again, _ = make([*ROUND[:60]], InlineMapping)
    again.load_map(tmp_path / "hall.map")
    seek, doubt, count = Seeker.seek, stage.doubt_of, 0
    monkeypatch.setattr(Seeker, "seek", lambda self, *what: seek(self, *what) if count >= 20 else None)
    monkeypatch.setattr(stage, "doubt_of", lambda *what: doubt(*what) if count >= 20 else "not yet")
    for count, frame in enumerate(frames(60)):  # noqa: B007  (the two above look at it)
        again.process(frame)
    run = again.finish()
    assert [f.index for f in run.frames if f.world_from_camera is None] == []
    assert ate(run, ROUND)[0] < 0.005


def test_visibility_is_counted_in_memory_of_the_landmarks() -> None:
    rng = np.random.default_rng(0)
    tally, all_visible, all_found = VisibilityTally(), [], []
    for _ in range(5 * MOST_FRAMES + 3):
        visible = rng.choice(300, 40, replace=False)
        found = visible[rng.random(40) < 0.5]
        tally.note(visible, found)
        all_visible.append(visible)
        all_found.append(found)
        assert len(tally._frames) < MOST_FRAMES
    counts = tally.take()
    ids, times = np.unique(np.concatenate(all_visible), return_counts=True)
    np.testing.assert_array_equal(counts.landmark_ids, ids)
    np.testing.assert_array_equal(counts.visible, times)
    np.testing.assert_array_equal(counts.found, [sum(int(i in f) for f in all_found) for i in ids])
    assert len(tally.take().landmark_ids) == 0
