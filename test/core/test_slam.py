"""The whole system with a fake front end: images carry nothing but their size and their bytes."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
from synthetic import BEGIN_NS, CAMERA, PERIOD_NS, FakeExtractor, FakeMatcher, World, cloud, loop, make_world, observe, room, sideways, stamp

from thegra_core.config import HistogramClip, PreprocessingConfig, ThegraConfig
from thegra_core.geometry.alignment import umeyama
from thegra_core.messages import Frame, Run, Shutter, TrackingResult, TrackingState
from thegra_core.slam import Slam

CONFIG = ThegraConfig(preprocessing=PreprocessingConfig(filters=(HistogramClip(),)))
WIDTH, HEIGHT = CAMERA.image_size


def picture(seed: int) -> np.ndarray:
    """An image that differs from every other one."""
    return np.random.default_rng(seed).integers(0, 255, (HEIGHT, WIDTH), dtype=np.uint8)


def frames(count: int, begin: int = 0) -> list[Frame]:
    return [Frame(stamp(i), i, picture(i)) for i in range(begin, begin + count)]


def make(world: World, path: list[np.ndarray], config: ThegraConfig = CONFIG, wrong: float = 0.0) -> Slam:
    extractor = FakeExtractor(world, {stamp(i): pose for i, pose in enumerate(path)})
    return Slam(CAMERA, config, extractor, FakeMatcher(wrong))


def play(slam: Slam, stream: list[Frame]) -> tuple[list[TrackingResult], Run]:
    results = [slam.process(frame) for frame in stream]
    return results, slam.finish()


def ate(run: Run, path: list[np.ndarray], live: bool = False) -> tuple[float, int]:
    """RMS position error of the main map's frames after a similarity, over the path's length; number of frames."""
    pairs = []
    for record in run.frames:
        pose = record.world_from_camera_live if live else record.world_from_camera
        index = (record.stamp_ns - BEGIN_NS) // PERIOD_NS
        if pose is not None and (live or record.map_id == run.main_map_id):
            pairs.append((pose[:3, 3], path[index][:3, 3]))
    found, true = np.array([a for a, _ in pairs]), np.array([b for _, b in pairs])
    scale, rotation, translation = umeyama(found, true)
    length = np.linalg.norm(np.diff(np.array([p[:3, 3] for p in path]), axis=0), axis=1).sum()
    return float(np.sqrt(((scale * found @ rotation.T + translation - true) ** 2).sum(axis=1).mean()) / length), len(pairs)


WALK = sideways(40, 0.05)


def walk_world() -> World:
    return cloud(count=500, seed=1, low=(-4, -3, 3), high=(7, 3, 8))


@pytest.fixture(scope="module")
def loop_run() -> tuple[list[TrackingResult], Run]:
    path = loop(120)
    return play(make(room(), path), frames(120))


def test_a_loop_end_to_end(loop_run: tuple[list[TrackingResult], Run]) -> None:
    results, run = loop_run
    error, placed = ate(run, loop(120))
    assert error < 0.005
    assert placed == 120, "frames before the first map are placed afterwards"
    live, tracked = ate(run, loop(120), live=True)
    assert live < 0.015 and tracked == sum(r.state is TrackingState.TRACKING for r in results) >= 110
    assert (run.main_map_id, len(run.maps), run.losses) == (0, 1, 0)


def test_frames_before_the_first_map_are_marked(loop_run: tuple[list[TrackingResult], Run]) -> None:
    results, run = loop_run
    waiting = [r.state is TrackingState.INITIALIZING for r in results]
    assert any(waiting)
    assert [f.localized_afterwards for f in run.frames] == waiting
    assert all(f.world_from_camera_live is None for f, w in zip(run.frames, waiting, strict=True) if w)


def test_the_account_is_complete(loop_run: tuple[list[TrackingResult], Run]) -> None:
    results, run = loop_run
    assert [f.index for f in run.frames] == list(range(120))
    assert [f.stamp_ns for f in run.frames] == [stamp(i) for i in range(120)]
    assert run.bad_frames == {} and run.shutter_closures_ns == ()
    summary = run.maps[0]
    assert len(summary.keyframe_poses) == len(summary.keyframe_stamps_ns) > 10
    assert (np.diff(summary.keyframe_stamps_ns) > 0).all()
    assert len(summary.points_world) == len(summary.point_scores) > 500
    by_stamp = {f.stamp_ns: f.world_from_camera for f in run.frames}
    for keyframe_stamp, pose in zip(summary.keyframe_stamps_ns.tolist(), summary.keyframe_poses, strict=True):
        np.testing.assert_array_equal(by_stamp[keyframe_stamp], pose)
    assert 1 <= len(run.snapshots) <= 8
    assert all(r.stage_ms["total"] >= r.stage_ms["tracking"] >= 0 for r in results)


def test_the_extractor_sees_the_preprocessed_image() -> None:
    slam = make(walk_world(), WALK)
    image = (picture(0).astype(np.uint16) * 3 + 20000).astype(np.uint16)
    slam.process(Frame(stamp(0), 0, image))
    (given,) = slam._extractor._inner.images  # type: ignore[attr-defined]
    assert given.dtype == np.uint8 and given.shape == (HEIGHT, WIDTH)
    assert given.min() == 0 and given.max() == 255


def test_two_runs_give_the_same_bytes() -> None:
    runs = [play(make(walk_world(), WALK, wrong=0.1), frames(40))[1] for _ in range(2)]
    a, b = ([None if f.world_from_camera is None else f.world_from_camera.tobytes() for f in run.frames] for run in runs)
    assert a == b
    assert runs[0].maps[0].points_world.tobytes() == runs[1].maps[0].points_world.tobytes()


def test_a_kidnapped_camera_relocalises_when_it_is_put_back() -> None:
    path = [*WALK[:25], *sideways(4, 0.05), *WALK[29:]]
    far = World(walk_world().points + [0, 0, 500], walk_world().descriptors, walk_world().scores)
    slam = make(walk_world(), path)
    for i in range(25, 29):
        del slam._extractor._inner.poses_by_stamp[stamp(i)]  # type: ignore[attr-defined]
    results, run = play(slam, frames(40))
    assert len(far.points) and {r.state for r in results[25:29]} == {TrackingState.LOST}
    assert {r.state for r in results[29:]} == {TrackingState.TRACKING}
    assert (run.losses, run.relocalizations, len(run.maps)) == (1, 1, 1)
    error, placed = ate(run, path)
    assert error < 0.005 and placed == 36


def rooms_alike(share: float) -> tuple[World, World]:
    """Two rooms of which a share of the points is the same."""
    here = room(3000)
    elsewhere = make_world(here.points, seed=99)
    alike = np.random.default_rng(0).random(len(here.points)) < share
    elsewhere.descriptors[alike] = here.descriptors[alike]
    return here, elsewhere


@pytest.mark.parametrize(("share", "found"), [(0.5, False), (0.0, True)])
def test_a_view_that_jumps_to_something_alike_is_lost(share: float, found: bool) -> None:
    """As below, without a frame in between: tracking does not go on in the other room."""
    here, elsewhere = rooms_alike(0.3)
    config = CONFIG.model_copy(update={"tracking": CONFIG.tracking.model_copy(update={"min_visible_share": share})})
    path = loop(110)[:28]
    slam = make(here, path, config)
    assert play(slam, frames(25))[0][24].state is TrackingState.TRACKING
    slam._extractor._inner.world = elsewhere  # type: ignore[attr-defined]
    assert (slam.process(frames(1, begin=25)[0]).state is TrackingState.TRACKING) is found


@pytest.mark.parametrize(("share", "found"), [(0.2, False), (0.0, True)])
def test_a_place_that_only_has_something_alike_is_not_this_one(share: float, found: bool) -> None:
    """An eighth of the points is the same in both rooms, as the cars of two streets are: enough for a pose, not for a place."""
    here, elsewhere = rooms_alike(0.125)
    config = CONFIG.model_copy(update={"relocalization": CONFIG.relocalization.model_copy(update={"min_visible_share": share})})
    path = loop(110)[:25]
    slam = make(here, path, config)
    results, _ = play(slam, frames(28))  # the last three show nothing
    assert results[24].state is TrackingState.TRACKING and results[-1].state is TrackingState.LOST
    slam.localization_only = True
    slam._extractor._inner.world = elsewhere  # type: ignore[attr-defined]
    slam._extractor._inner.poses_by_stamp.update({stamp(28 + i): pose for i, pose in enumerate(path[::5])})  # type: ignore[attr-defined]
    lost = [slam.process(frame) for frame in frames(5, begin=28)]
    assert (TrackingState.TRACKING in {r.state for r in lost}) is found
    slam._extractor._inner.world = here  # type: ignore[attr-defined]
    slam._extractor._inner.poses_by_stamp.update({stamp(33): path[12]})  # type: ignore[attr-defined]
    assert slam.process(frames(1, begin=33)[0]).state is TrackingState.TRACKING, "its own place is"


def test_a_lost_camera_begins_a_new_map_and_keeps_the_old() -> None:
    other = cloud(count=500, seed=9, low=(-4, -3, 3), high=(7, 3, 8))
    joined = World(np.concatenate([walk_world().points, other.points + [0, 1000, 0]]), np.concatenate([walk_world().descriptors, other.descriptors]),
                   np.concatenate([walk_world().scores, other.scores]))  # fmt: skip
    elsewhere = [pose.copy() for pose in sideways(50, 0.05)]
    for pose in elsewhere:
        pose[1, 3] += 1000
    slam = make(joined, [*sideways(25, 0.05), *elsewhere])
    results, run = play(slam, frames(75))
    assert len(run.maps) == 2 and run.losses == 1
    assert run.main_map_id == 1, "the map with most frames"
    assert {r.map_id for r in results[-20:]} == {1}
    first = [f for f in run.frames if f.map_id == 0]
    assert len(first) == 25, "frames before the first map are placed in it although a second one followed"


def test_frames_on_probation_have_a_place_only_if_the_map_stands(loop_run: tuple[list[TrackingResult], Run]) -> None:
    results, run = loop_run
    on_probation = [i for i, r in enumerate(results) if "probation" in r.reason]
    assert len(on_probation) == CONFIG.initialization.probation_frames
    assert all(run.frames[i].map_id == 0 and run.frames[i].localized_afterwards for i in on_probation)
    slam = make(room(), loop(120))
    for frame in frames(on_probation[1]):
        slam.process(frame)
    unproven = slam.finish()
    assert (unproven.maps, unproven.main_map_id) == ((), -1)
    assert all(f.world_from_camera is None for f in unproven.frames)


def test_hold_while_the_image_repeats() -> None:
    slam = make(walk_world(), WALK)
    stream = frames(40)
    stream[25:31] = [Frame(stamp(i), i, stream[24].image) for i in range(25, 31)]
    results, run = play(slam, stream)
    assert {r.state for r in results[25:31]} == {TrackingState.HOLD}
    assert {r.state for r in results[31:]} == {TrackingState.TRACKING}
    assert all(f.predicted is not None and f.world_from_camera is None for f in run.frames[25:31])
    assert run.shutter_closures_ns == ((stamp(25), stamp(30)),)
    assert run.losses == 0


def test_a_gap_in_the_stream_is_a_closure_too() -> None:
    path = sideways(60, 0.03)
    slam = make(walk_world(), path)
    stream = [f for f in frames(60) if not 30 <= f.index < 42]
    _, run = play(slam, stream)
    assert len(run.shutter_closures_ns) == 1
    begin, end = run.shutter_closures_ns[0]
    assert stamp(29) <= begin < end <= stamp(42)


# ---- bad frames ----------------------------------------------------------------------------------------------------------------------


def spoil(image: np.ndarray) -> dict[str, Callable[[], np.ndarray]]:
    nan = image.astype(np.float32)
    nan[3, 3] = np.nan
    return {
        "other size": lambda: np.zeros((HEIGHT // 2, WIDTH), np.uint8),
        "transposed": lambda: np.ascontiguousarray(image.T),
        "colour": lambda: np.stack([image] * 3, axis=2),
        "empty": lambda: np.zeros((0, 0), np.uint8),
        "nan": lambda: nan,
        "infinity": lambda: np.where(np.isnan(nan), np.inf, nan).astype(np.float32),
    }


@pytest.mark.parametrize("kind", ["other size", "transposed", "colour", "empty", "nan", "infinity"])
def test_bad_images_are_counted_and_change_nothing(kind: str) -> None:
    slam = make(walk_world(), WALK)
    stream = frames(30)
    for bad in (0, 1, 18, 19):
        stream[bad] = Frame(stamp(bad), bad, spoil(picture(bad))[kind]())
    results, run = play(slam, stream)
    assert sum(run.bad_frames.values()) == 4 and len(run.bad_frames) == 1
    assert all(results[i].world_from_camera is None and results[i].reason for i in (0, 1, 18, 19))
    assert {r.state for r in results[20:]} == {TrackingState.TRACKING}
    assert run.losses == 0
    assert len(run.frames) == 30


def test_repeated_and_backward_stamps_are_counted_and_get_no_pose() -> None:
    slam = make(walk_world(), WALK)
    stream: list[Frame] = []
    for frame in frames(30):
        stream.append(frame)
        if frame.index % 3 == 2:
            stream.append(Frame(frame.stamp_ns, 100 + frame.index, picture(1000 + frame.index)))
        if frame.index % 5 == 4:
            stream.append(Frame(frame.stamp_ns - 2 * PERIOD_NS, 200 + frame.index, picture(2000 + frame.index)))
    results, run = play(slam, stream)
    assert run.bad_frames == {"stamp repeats": 10, "stamp goes backwards": 6}
    assert sum(r.state is TrackingState.TRACKING for r in results) >= 24
    bad = [f for f in run.frames if f.index >= 100]
    assert len(bad) == 16
    assert [f.index for f in bad if f.world_from_camera is not None] == [], "a trajectory has each stamp once"
    stamps = [f.stamp_ns for f in run.frames if f.world_from_camera is not None]
    assert stamps == sorted(set(stamps))


def test_one_stamp_far_in_the_future_does_not_end_the_run() -> None:
    slam = make(walk_world(), WALK)
    stream = frames(40)
    stream[20] = Frame(stamp(20) + 10**18, 20, picture(20))
    results, _ = play(slam, stream)
    assert sum(r.state is TrackingState.TRACKING for r in results[30:]) >= 8


@pytest.mark.parametrize("value", [0, 255, 77])
def test_blank_images_hold_the_pose(value: int) -> None:
    slam = make(walk_world(), WALK)
    stream = frames(30)
    for blank in (0, 20, 21):
        stream[blank] = Frame(stamp(blank), blank, np.full((HEIGHT, WIDTH), value, np.uint8))
    results, run = play(slam, stream)
    assert [results[i].state for i in (0, 20, 21)] == [TrackingState.HOLD] * 3
    assert results[0].world_from_camera is None
    assert {r.state for r in results[22:]} == {TrackingState.TRACKING}
    assert run.bad_frames == {}


@pytest.mark.parametrize("dtype", [np.float32, np.uint16])
def test_other_types_of_pixels_work(dtype: type) -> None:
    slam = make(walk_world(), WALK)
    stream = [Frame(f.stamp_ns, f.index, (f.image.astype(np.float64) * 10 + 7000).astype(dtype)) for f in frames(20)]
    results, run = play(slam, stream)
    assert run.bad_frames == {} and results[-1].state is TrackingState.TRACKING


def test_frames_without_keypoints_never_crash() -> None:
    empty = Slam(CAMERA, CONFIG, FakeExtractor(walk_world(), {}), FakeMatcher())
    results, run = play(empty, frames(12))
    assert {r.state for r in results} == {TrackingState.INITIALIZING}
    assert all(r.reason for r in results)
    assert (run.main_map_id, run.maps) == (-1, ())
    nothing = Slam(CAMERA, CONFIG, FakeExtractor(walk_world(), {}), FakeMatcher()).finish()
    assert nothing.frames == () and nothing.main_map_id == -1


def test_a_run_of_nothing_but_bad_frames() -> None:
    slam = make(walk_world(), WALK)
    results, run = play(slam, [Frame(stamp(i), i, np.zeros((5, 5), np.uint8)) for i in range(5)])
    assert len(run.frames) == 5 and all(f.world_from_camera is None for f in run.frames)
    assert all(r.world_from_camera is None for r in results)
    assert slam.snapshot() is None


def test_few_keypoints_never_crash() -> None:
    """A world of a handful of points: not enough for a map, at any number."""
    for count in (1, 3, 8, 20):
        slam = make(cloud(count=count, seed=3), WALK)
        slam._extractor._inner.clutter = 0  # type: ignore[attr-defined]
        _, run = play(slam, frames(6))
        assert run.main_map_id == -1


def test_the_world_thins_out_while_tracking() -> None:
    """Fewer and fewer keypoints a frame until none is left, then all again."""
    slam = make(walk_world(), WALK)
    extractor = slam._extractor
    results = []
    for index, frame in enumerate(frames(40)):
        extractor.seen = 0.9 if index < 15 or index > 30 else max(0.0, 0.9 - 0.08 * (index - 15))  # type: ignore[attr-defined]
        results.append(slam.process(frame))
    assert all((r.world_from_camera is not None) == (r.state is TrackingState.TRACKING) for r in results)
    run = slam.finish()
    error, _ = ate(run, WALK)
    assert error < 0.01, "whatever was claimed with few points is right"


def test_snapshot_and_current_map_for_viewers() -> None:
    slam = make(walk_world(), WALK)
    assert slam.snapshot() is None
    assert slam.current_map() is None and slam.map_size() == (0, 0)
    for frame in frames(20):
        slam.process(frame)
    view = slam.snapshot()
    assert view is not None and view.state is TrackingState.TRACKING
    assert view.image.shape == (HEIGHT, WIDTH) and len(view.keypoints) == len(view.tracked) == len(view.previous)
    assert view.tracked.sum() > 50
    shown = slam.current_map()
    assert shown is not None and len(shown.keyframe_poses) > 2 and len(shown.points_world) > 50
    assert slam.map_size() == (len(shown.keyframe_poses), len(shown.points_world))
    matched = view.tracked & np.isfinite(view.previous).all(axis=1)
    shift = np.linalg.norm(view.keypoints[matched] - view.previous[matched], axis=1)
    assert matched.sum() > 30 and shift.max() < 150


def test_noise_of_the_front_end_is_repeatable() -> None:
    """The test's own premise: a frame looks the same whenever it is asked for."""
    a, b = (observe(walk_world(), WALK[3], stamp(3)) for _ in range(2))
    assert a.keypoints.tobytes() == b.keypoints.tobytes()
    assert Shutter.OPEN is not Shutter.CLOSED


def test_a_system_that_is_given_up_gives_its_memory_back() -> None:
    """What a reset does: the old system goes, another begins. Nothing may hold on to the old map."""
    stream = frames(30)
    play(make(walk_world(), WALK), stream[:12])  # what is loaded once for all
    tracemalloc.start()
    try:
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        slam = make(walk_world(), WALK)
        for frame in stream:
            slam.process(frame)
        held = tracemalloc.get_traced_memory()[0] - before
        del slam
        gc.collect()
        left = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert held > 1 << 20 and left < 0.05 * held
