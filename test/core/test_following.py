"""The whole system with keypoints that are followed, and with mapping in a process of its own; the front end is a made world that numbers its points."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from synthetic import CAMERA, FakeExtractor, FakeMatcher, World, cloud, look, observe, sideways, stamp
from test_slam import CONFIG, ate, frames

from thegra_core.config import FlowConfig, ThegraConfig
from thegra_core.errors import MappingError, WeightsError
from thegra_core.features.protocols import Wanted
from thegra_core.features.tracks import TrackMatcher
from thegra_core.mapping.mapper import Mapper
from thegra_core.mapping.process import MappingProcess
from thegra_core.mapping.service import MOST_LEFT, InlineMapping
from thegra_core.messages import NO_LANDMARK, UNFOLLOWED, Features, Keyframe, MapUpdate, Run, TrackingResult, TrackingState
from thegra_core.slam import Slam
from thegra_core.tracking.keyframe_policy import ANSWER_NS, tracked_ratio

FOLLOWING = CONFIG.model_copy(update={"flow": FlowConfig(enabled=True)})
WALK = sideways(60, 0.025)


def world() -> World:
    return cloud(count=900, seed=1, low=(-4, -3, 3), high=(7, 3, 8))


def fake_matcher(config: ThegraConfig) -> TrackMatcher:
    """What a process of mapping builds."""
    return TrackMatcher(FakeMatcher(), config.flow.min_shared)


def no_weights(config: ThegraConfig) -> TrackMatcher:
    raise WeightsError("there are no weights of the fake matcher")


class WorldFrontEnd:
    """Detects 400 points of a world and follows them exactly as far as they stay in view; the numbers of tracks are new with each detection anew."""

    def __init__(self, of: World, path: dict[int, np.ndarray], noise_px: float = 0.2) -> None:
        self.world, self.path, self.noise_px = of, path, noise_px
        self.known: dict[int, int] = {}  # point -> track
        self.last = 0
        self.next = 0
        self.asked: list[Wanted] = []
        self.detected: list[int] = []
        self.expected: list[int] = []
        self.misled = False

    def seen(self) -> tuple[Features, np.ndarray]:
        found = observe(self.world, self.path[self.last], self.last, self.noise_px)
        return found, (found.descriptors @ self.world.descriptors.T).argmax(axis=1)

    def follow(self, image: np.ndarray, stamp_ns: int, likely: bool = False) -> Features | None:
        self.last = stamp_ns
        self.expected += [stamp_ns] * likely
        if not self.known:
            return None
        found, points = self.seen()
        kept = np.flatnonzero(np.isin(points, list(self.known)))
        self.known = {p: self.known[p] for p in points[kept].tolist()}
        if len(kept) < 80:
            return None
        keypoints = found.keypoints[kept] + (np.random.default_rng(1).uniform(-40, 40, (len(kept), 2)).astype(np.float32) if self.misled else 0)
        return self._pick(found, kept, keypoints, [self.known[p] for p in points[kept].tolist()])

    def detect(self, wanted: Wanted = Wanted.MORE) -> Features:
        self.asked.append(wanted)
        self.detected.append(self.last)
        found, points = self.seen()
        if wanted is Wanted.ANEW:
            self.known = {}
        old = np.flatnonzero(np.isin(points, list(self.known)))
        new = np.flatnonzero(~np.isin(points, list(self.known)))[: max(400 - len(old), 0)]
        for point in points[new].tolist():
            self.known[point], self.next = self.next, self.next + 1
        rows = np.concatenate((old, new))
        return self._pick(found, rows, found.keypoints[rows], [self.known[p] for p in points[rows].tolist()])

    def forget(self) -> None:
        self.known = {}

    @staticmethod
    def _pick(found: Features, rows: np.ndarray, keypoints: np.ndarray, ids: list[int]) -> Features:
        return replace(found, keypoints=keypoints, scores=found.scores[rows], descriptors=found.descriptors[rows], track_ids=np.array(ids, np.int64))


def make(path: list[np.ndarray], config: ThegraConfig = FOLLOWING) -> tuple[Slam, WorldFrontEnd, FakeMatcher]:
    by_stamp = {stamp(i): pose for i, pose in enumerate(path)}
    matcher = FakeMatcher()
    slam = Slam(CAMERA, config, FakeExtractor(world(), by_stamp), matcher)
    slam._front_end = end = WorldFrontEnd(world(), by_stamp)
    return slam, end, matcher


def play(slam: Slam, count: int, begin: int = 0) -> list[TrackingResult]:
    return [slam.process(frame) for frame in frames(count, begin)]


@pytest.fixture(scope="module")
def walked() -> tuple[list[TrackingResult], Run, WorldFrontEnd, FakeMatcher]:
    slam, end, matcher = make(WALK)
    results = play(slam, 60)
    return results, slam.finish(), end, matcher


def test_followed_points_carry_the_camera_along(walked: tuple[list[TrackingResult], Run, WorldFrontEnd, FakeMatcher]) -> None:
    results, run, end, _ = walked
    error, placed = ate(run, WALK)
    assert error < 0.003 and placed == 60
    assert (run.losses, len(run.maps)) == (0, 1)
    keyframes = sum(r.is_keyframe for r in results)
    assert 3 < len(end.asked) < 30, "most frames are followed"
    assert len(end.asked) <= keyframes + 3 and Wanted.ANEW not in end.asked
    live, _ = ate(run, WALK, live=True)
    assert live < 0.01


def test_a_keyframe_is_mostly_expected_before_its_image_is_looked_at(walked: tuple[list[TrackingResult], Run, WorldFrontEnd, FakeMatcher]) -> None:
    results, _, end, _ = walked
    begun = next(r.stamp_ns for r in results if r.is_keyframe)
    detected, expected = ({s for s in stamps if s > begun} for stamps in (end.detected, end.expected))
    assert len(detected) > 3
    assert len(expected & detected) > 0.5 * len(detected), "detection begins beside following"
    assert len(expected - detected) < 0.5 * len(detected), "and rarely for nothing"


def test_a_camera_that_is_lost_is_detected_in() -> None:
    slam, end, _ = make(WALK)
    play(slam, 25)
    end.path = {s: look([500.0, 0, 0], 90) for s in end.path}
    end.forget()
    lost = play(slam, 3, 25)
    assert lost[0].state is not TrackingState.TRACKING
    assert stamp(27) in end.expected and stamp(27) in end.detected


def test_matches_come_from_the_tracks(walked: tuple[list[TrackingResult], Run, WorldFrontEnd, FakeMatcher]) -> None:
    _, run, _, matcher = walked
    assert len(run.maps[0].keyframe_poses) > 5
    assert matcher.calls < 0.5 * len(run.maps[0].keyframe_poses), "keyframes share tracks with their neighbours"


def test_the_same_frames_give_the_same_bytes() -> None:
    runs = []
    for _ in range(2):
        slam, _, _ = make(WALK)
        play(slam, 30)
        runs.append([None if f.world_from_camera is None else f.world_from_camera.tobytes() for f in slam.finish().frames])
    assert runs[0] == runs[1]


def test_where_following_misleads_the_frame_is_matched_anew() -> None:
    slam, end, _ = make(WALK)
    play(slam, 25)
    end.misled, before = True, len(end.asked)
    result = play(slam, 1, 25)[0]
    end.misled = False
    assert result.state is TrackingState.TRACKING and end.asked[before:] == [Wanted.ANEW]
    assert all(r.state is TrackingState.TRACKING for r in play(slam, 15, 26))
    assert slam.finish().losses == 0


def test_points_that_are_found_again_after_a_closure_are_followed_across() -> None:
    slam, end, _ = make(WALK)
    play(slam, 25)
    image, before = frames(1, 25)[0].image, len(end.asked)
    held = [slam.process(replace(frame, image=image)) for frame in frames(4, 25)]
    assert held[-1].state is TrackingState.HOLD
    results = play(slam, 4, 29)
    assert all(r.state is TrackingState.TRACKING for r in results)
    assert Wanted.ANEW not in end.asked[before:]
    assert slam.finish().losses == 0


def test_after_a_closure_that_cannot_be_followed_across_the_frame_is_matched() -> None:
    slam, end, _ = make(WALK)
    play(slam, 25)
    image = frames(1, 25)[0].image
    for frame in frames(4, 25):
        slam.process(replace(frame, image=image))
    end.forget()
    assert play(slam, 1, 29)[0].state is TrackingState.TRACKING
    assert slam.finish().losses == 0


def test_a_camera_that_only_turns_claims_nothing() -> None:
    turning = [look([0, 0, 0], 0.8 * i, 0.1 * i) for i in range(40)]
    slam, _, _ = make(turning)
    assert all(r.world_from_camera is None for r in play(slam, 40))
    assert slam.finish().maps == ()


# ---- mapping in a process of its own ----------------------------------------------------------------------------------------------


@pytest.fixture
def beside() -> Iterator[Slam]:
    slam, _, _ = make(WALK)
    slam._mapping = MappingProcess(CAMERA, FOLLOWING, fake_matcher)
    slam.usage()  # it is ready
    yield slam
    slam.close()


def process_all(slam: Slam, count: int, begin: int = 0) -> list[TrackingResult]:
    """Frames that come slowly: mapping has done everything before the next one."""
    results = []
    for frame in frames(count, begin):
        results.append(slam.process(frame))
        slam.usage()
    return results


def test_a_process_of_its_own_maps_as_well(beside: Slam) -> None:
    process_all(beside, 60)
    run = beside.finish()
    error, placed = ate(run, WALK)
    assert error < 0.004 and placed == 60
    assert (run.losses, len(run.maps)) == (0, 1) and len(run.maps[0].keyframe_poses) > 5
    used = beside.usage()
    assert used.cpu_s > 0 and used.peak_rss_mb > 50


def test_new_landmarks_come_before_they_are_adjusted(beside: Slam) -> None:
    """A keyframe is answered three times: by the landmarks of its known matches, by those of others, and by where everything is after the adjustment."""
    updates, taken = beside._mapping.updates, []

    def recorded(patience_s: float = 0.0) -> list[MapUpdate]:
        got = updates(patience_s)
        taken.extend(got)
        return got

    beside._mapping.updates = recorded  # type: ignore[method-assign]
    process_all(beside, 40)
    beside._take_updates()
    answers = taken[1:]  # the first map comes before
    assert len(answers) > 9 and len(answers) % 3 == 0
    for first, second, third in zip(*[iter(answers)] * 3, strict=True):
        assert [len(u.new_keyframes) for u in (first, second, third)] == [1, 0, 0]
        assert [u.version - first.version for u in (second, third)] == [1, 2]
        assert first.landmarks is not None and len(first.landmarks.ids) > 0
        assert first.new_keyframes[0].id in {k.id for k in third.keyframes}
    (own,), known = beside._mapping.maps(), beside._tracking.map
    assert known is not None and known.keyframes.keys() == own.keyframes.keys()
    for i, keyframe in own.keyframes.items():
        np.testing.assert_array_equal(known.keyframes[i].world_from_camera, keyframe.world_from_camera)


class Hesitant(InlineMapping):
    """Answers a keyframe step by step, one step each time that it is waited for."""

    def __init__(self) -> None:
        super().__init__(Mapper(CAMERA, FOLLOWING, fake_matcher(FOLLOWING)))
        self.hesitates = False
        self.waited_for = 0
        self._steps: list[MapUpdate] = []

    def insert(self, keyframe: Keyframe) -> None:
        self._steps += self.insert_by_steps(keyframe, lambda: False)

    def updates(self, patience_s: float = 0.0) -> list[MapUpdate]:
        if not self.hesitates:
            self._updates, self._steps = [*self._updates, *self._steps], []
        elif patience_s > 0 and self._steps:
            self.waited_for += 1
            self._updates.append(self._steps.pop(0))
        return super().updates()


def test_a_frame_that_sees_no_landmarks_waits_for_those_of_the_last_keyframe() -> None:
    slam, end, _ = make(WALK)
    slam._mapping = mapping = Hesitant()
    play(slam, 25)
    mapping.hesitates = True
    i = next(i for i in range(25, 45) if play(slam, 1, i)[0].is_keyframe)
    slam._tracking._place.tracks._landmarks[:] = NO_LANDMARK  # type: ignore[union-attr]
    asked = len(end.asked)
    result = play(slam, 1, i + 1)[0]
    assert result.state is TrackingState.TRACKING and mapping.waited_for == 1
    assert len(end.asked) == asked, "nothing had to be detected"
    slam._tracking._place.tracks._landmarks[:] = NO_LANDMARK  # type: ignore[union-attr]
    assert play(slam, 1, i + 2)[0].state is TrackingState.TRACKING and mapping.waited_for == 1, "its keyframe has been answered"
    assert len(end.asked) > asked


def test_nothing_hangs_on_the_keyframe_of_a_camera_that_was_found_again_before_it_is_adjusted() -> None:
    slam, _, _ = make(WALK)
    slam._mapping = mapping = Hesitant()
    play(slam, 25)
    place = slam._tracking._place
    assert place is not None
    mapping.hesitates = True
    for i in range(25, 35):
        place.lost_frames = 1
        found = play(slam, 1, i)[0]
        if found.is_keyframe:
            break
    assert found.state is TrackingState.TRACKING and found.is_keyframe
    results = play(slam, 12, i + 1)
    assert all(r.state is TrackingState.TRACKING and not r.is_keyframe for r in results)
    mapping.hesitates = False
    assert any(r.is_keyframe for r in play(slam, 3, i + 13)), "and then it goes on"


class Scripted(InlineMapping):
    """Mapping in which others wait after the steps told."""

    def __init__(self, waits: list[bool]) -> None:
        super().__init__(Mapper(CAMERA, FOLLOWING, fake_matcher(FOLLOWING)))
        self.waits = waits
        self.steps: list[str] = []
        for name in ("grow", "settle", "tie"):
            setattr(self._mapper, name, self._noted(name, getattr(self._mapper, name)))

    def _noted(self, name: str, step: Callable[..., Any]) -> Callable[..., Any]:
        def noted(keyframe: Keyframe, *others_wait: Callable[[], bool]) -> Any:
            self.steps.append(name)
            return step(keyframe)  # as if nobody waited while it grows: each answer of the script is that after a step

        return noted

    def insert(self, keyframe: Keyframe) -> None:
        self._updates += self.insert_by_steps(keyframe, lambda: self.waits.pop(0) if self.waits else False)


def scripted(waits: list[bool]) -> tuple[Slam, Scripted]:
    slam, _, _ = make(WALK)
    slam._mapping = mapping = Scripted(waits)
    return slam, mapping


@pytest.mark.parametrize(("waits", "steps"), [([True], ["grow"]), ([False, True], ["grow", "settle"]), ([], ["grow", "settle", "tie"])])
def test_a_keyframe_is_left_while_others_wait(waits: list[bool], steps: list[str]) -> None:
    slam, mapping = scripted(waits)
    play(slam, 25)
    assert mapping.steps[: len(steps) + 3] == [*steps, "grow", "settle", "tie"], "the next one, for which none waits, is done"
    assert slam.finish().losses == 0


def test_not_more_than_a_few_keyframes_in_a_row_are_left_unadjusted() -> None:
    slam, mapping = scripted([True] * 1000)
    play(slam, 60)
    between = "".join(step[0] for step in mapping.steps).split("st")
    assert {len(grown) for grown in between[:-1]} == {MOST_LEFT + 1} and len(between[-1]) <= MOST_LEFT
    assert ate(slam.finish(), WALK)[0] < 0.005


def test_a_map_that_took_its_time_is_caught_up_with() -> None:
    """Frames that came while the first map was solved become keyframes of it, so that there are new landmarks at once."""
    slam, _, _ = make(WALK)
    late: list[Callable[[], None]] = []

    def submit(function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        future, solved = Future[Any](), function(*arguments)
        if isinstance(solved, str):
            future.set_result(solved)
        else:
            late.append(lambda: future.set_result(solved))
        return future

    slam._tracking._initializer._submit = submit
    begun = next(i for i in range(60) if slam.process(frames(1, i)[0]) and late)
    play(slam, 9, begun + 1)
    late[0]()
    play(slam, 1, begun + 10)
    keyframes = slam.map_size()[0]
    first = play(slam, 1, begun + 11)[0]
    assert first.state is TrackingState.TRACKING and not first.is_keyframe
    assert slam.map_size()[0] > keyframes > 0, "keyframes from the time in between"
    assert all(r.state is TrackingState.TRACKING for r in play(slam, 15, begun + 12))
    assert slam.finish().losses == 0


@pytest.mark.parametrize(("pending", "age_ns", "ratio"), [(True, ANSWER_NS - 1, 0.75), (True, ANSWER_NS, 0.2), (False, 1, 0.2)])
def test_how_much_of_a_keyframe_without_an_answer_is_seen_is_told_by_its_tracks(pending: bool, age_ns: int, ratio: float) -> None:
    """Its landmarks are not known yet, and those of the one before are few by then: without its tracks the next frame would be a keyframe, too."""
    slam, _, _ = make(WALK)
    play(slam, 30)
    place = slam._tracking._place
    assert place is not None
    known, count = place.map.keyframes[place.reference_id], len(place.reference)
    ids = np.arange(count)
    sent = replace(known.features, track_ids=np.where(ids < 100, ids, UNFOLLOWED))
    place.pending = {99: Keyframe(99, sent.stamp_ns, np.eye(4), sent, np.full(count, NO_LANDMARK), 0, 0)} if pending else {}
    now = replace(sent.chosen(np.arange(25, 100)), stamp_ns=sent.stamp_ns + age_ns)
    landmarks = int((place.map.landmarks.rows(known.landmark_ids) >= 0).sum())
    assert tracked_ratio(place, now, landmarks // 5) == pytest.approx(ratio, abs=0.01)


def test_a_keyframe_that_is_due_by_the_followed_points_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """The image has been detected in for it; that more landmarks are found so does not make it needless, for they are not all followed."""
    slam, end, _ = make(WALK)
    play(slam, 25)
    answers = iter(["", "due by the followed points"])  # it was not expected
    monkeypatch.setattr("thegra_core.tracking.stage.needs_keyframe", lambda *_: next(answers, ""))
    assert [r.is_keyframe for r in play(slam, 3, 25)] == [True, False, False]
    assert end.asked[-1] is Wanted.MORE


def test_tracking_goes_on_while_mapping_is_behind(beside: Slam) -> None:
    process_all(beside, 25)
    held_back = beside._mapping.updates
    beside._mapping.updates = lambda patience_s=0.0: []  # type: ignore[method-assign]
    results = play(beside, 20, 25)
    assert all(r.state is TrackingState.TRACKING for r in results)
    assert sum(r.is_keyframe for r in results) == FOLLOWING.keyframe.most_pending
    beside._mapping.updates = held_back  # type: ignore[method-assign]
    beside.usage()
    assert any(r.is_keyframe for r in process_all(beside, 10, 45))
    error, _ = ate(beside.finish(), WALK)
    assert error < 0.005


def test_a_process_that_dies_is_reported(beside: Slam) -> None:
    process_all(beside, 25)
    beside._mapping._process.kill()  # type: ignore[attr-defined]
    beside._mapping._process.wait()  # type: ignore[attr-defined]
    with pytest.raises(MappingError, match=r"ended with code -9 \(killed; out of memory\?\)"):
        play(beside, 20, 25)
    run = beside.finish()
    assert len(run.maps) == 1 and ate(run, WALK)[0] < 0.01, "what tracking knows of the map is kept"


def test_an_error_in_the_process_is_told(beside: Slam) -> None:
    process_all(beside, 25)
    beside._mapping._tell("insert", "not a keyframe")  # type: ignore[attr-defined]
    with pytest.raises(MappingError, match="AttributeError"):
        beside.usage()


def test_missing_weights_are_told_as_such() -> None:
    mapping = MappingProcess(CAMERA, FOLLOWING, no_weights)
    with pytest.raises(WeightsError, match="no weights of the fake matcher"):
        mapping.usage()
    mapping.close()
    assert mapping._process.returncode is not None


def test_a_map_can_be_saved_and_read_in_a_process(beside: Slam, tmp_path) -> None:
    process_all(beside, 30)
    beside.save_map(tmp_path / "kept.map")
    slam, _, _ = make(WALK)
    slam._mapping = MappingProcess(CAMERA, FOLLOWING, fake_matcher)
    slam.load_map(tmp_path / "kept.map")
    results = process_all(slam, 10, 25)
    slam.close()
    assert all(r.state is TrackingState.TRACKING for r in results)


def test_a_process_begins_anew_without_what_it_had(beside: Slam) -> None:
    """What is still in work for the old stream is not told to the new one."""
    process_all(beside, 25)
    assert any(r.is_keyframe for r in play(beside, 10, 25))
    process = beside._mapping
    process.begin(CAMERA)  # type: ignore[attr-defined]
    assert process.maps() == [] and process.updates() == []
    slam, _, _ = make(WALK)
    slam._mapping = process
    process_all(slam, 40)
    run = slam.finish()
    error, placed = ate(run, WALK[:40])
    assert error < 0.005 and placed == 40 and [m.map_id for m in run.maps] == [0]
