"""Closed shutters, and streams that must not look like one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from thegra_core.config import ShutterConfig
from thegra_core.messages import Frame, Shutter
from thegra_core.preprocessing.shutter import ShutterDetector
from thegra_core.sources.open import open_recording

OPEN, CLOSED, JUST_OPENED = Shutter.OPEN, Shutter.CLOSED, Shutter.JUST_OPENED
MS = 1_000_000


def image(seed, dtype=np.uint16):
    """A static scene with sensor noise."""
    scene = 3000 + np.arange(64 * 80).reshape(64, 80) % 97
    return (scene + np.random.default_rng(seed).normal(0, 2, scene.shape)).astype(dtype)


def run(images, stamps=None, config=None):
    detector = ShutterDetector(config or ShutterConfig())
    stamps = stamps if stamps is not None else [1_700_000_000_000_000_000 + i * 40 * MS for i in range(len(images))]
    return [detector.update(Frame(int(t), i, picture)) for i, (t, picture) in enumerate(zip(stamps, images, strict=True))]


def states(images, stamps=None, config=None):
    return [s.shutter for s in run(images, stamps, config)]


def test_frozen_frames():
    images = [image(i) for i in range(5)]
    images = images[:3] + [images[2].copy() for _ in range(4)] + images[3:]
    assert states(images) == [OPEN] * 3 + [CLOSED] * 4 + [JUST_OPENED, OPEN]
    opened = run(images)[7]
    assert opened.reason == "first new image after 0.20 s, 4 frames"


def test_nearly_frozen_frames_with_an_overlay():
    frozen = []
    for i in range(4):
        picture = image(0)
        picture[1, 1 + i] = 0
        frozen.append(picture)
    assert states([image(5), *frozen, image(6)]) == [OPEN, OPEN, CLOSED, CLOSED, CLOSED, JUST_OPENED]


def test_blank_frames():
    blank = np.full((64, 80), 77, np.uint16)
    assert states([image(0), blank, blank + 1, image(1), image(2)]) == [OPEN, CLOSED, CLOSED, JUST_OPENED, OPEN]
    begins_blank = run([blank, blank, image(0)])
    assert begins_blank[2].reason == "first new image after 0.08 s, 2 frames"


def test_static_scene_with_noise_stays_open():
    assert states([image(i) for i in range(40)]) == [OPEN] * 40
    jpeg = [cv2.imdecode(cv2.imencode(".jpg", (image(i) >> 5).astype(np.uint8))[1], cv2.IMREAD_UNCHANGED) for i in range(20)]
    assert states(jpeg) == [OPEN] * 20


def test_gap_in_an_even_stream():
    rng = np.random.default_rng(0)
    stamps = 10**18 + np.arange(40) * 40 * MS + rng.integers(-2 * MS, 2 * MS, 40)
    stamps[30:] += 900 * MS
    result = run([image(i) for i in range(40)], stamps)
    assert [s.shutter for s in result] == [OPEN] * 30 + [JUST_OPENED] + [OPEN] * 9
    assert result[30].reason.startswith("gap of 0.9")


def test_few_lost_frames_are_no_gap():
    stamps = 10**18 + np.delete(np.arange(44), [20, 21, 35]) * 40 * MS
    assert set(states([image(i) for i in range(41)], stamps)) == {OPEN}


def test_photo_flights_have_no_gaps():
    images = [image(i) for i in range(40)]
    steps = np.array([1, 2, 1, 2, 2, 4, 1, 2] * 5) * 10**9
    steps[25] = 30 * 10**9
    assert set(states(images, 10**18 + np.cumsum(steps))) == {OPEN}
    even = np.full(40, 2 * 10**9)
    even[25] = 30 * 10**9
    assert set(states(images, 10**18 + np.cumsum(even))) == {OPEN}, "stamps of whole seconds"
    uneven = np.cumsum(np.random.default_rng(0).uniform(1.0, 4.0, 40) * 1e9)
    uneven[25:] += 30e9
    assert set(states(images, uneven)) == {OPEN}


def test_stream_padded_to_a_higher_rate_becomes_open():
    images = [image(int(i * 0.3)) for i in range(60)]  # 9 Hz sensor in 30 Hz video: runs of two and three repeats
    result = states(images)
    assert CLOSED in result[:10]
    assert set(result[12:]) == {OPEN}
    frozen = states(images + [images[-1]] * 8 + [image(99)])
    assert frozen[-9:] == [OPEN] + [CLOSED] * 7 + [JUST_OPENED]


def test_stamps_that_do_not_advance_say_nothing():
    first, second = image(0), image(1)
    assert states([first, first, second, second], [100, 100, 200, 150]) == [OPEN] * 4


def test_change_of_size_is_a_new_image():
    assert states([image(0), image(0)[:, :40], image(0)]) == [OPEN] * 3


def test_repeats_with_another_constant_are_repeats():
    frozen = image(2)
    images = [image(0), image(1), frozen, frozen + 7, frozen - 5, image(3)]
    assert states(images) == [OPEN, OPEN, OPEN, CLOSED, CLOSED, JUST_OPENED]


def test_what_the_camera_says():
    detector = ShutterDetector(ShutterConfig())
    flags = [None, False, True, True, False, False]
    said = [detector.update(Frame(10**18 + i * 40 * MS, i, image(i), flag)) for i, flag in enumerate(flags)]
    assert [s.shutter for s in said] == [OPEN, OPEN, CLOSED, CLOSED, JUST_OPENED, OPEN]
    assert said[2].reason == "the camera says so"
    assert [s.recalibrated for s in said] == [False] * 4 + [True, False]


def test_blade_in_front_of_the_sensor():
    rng = np.random.default_rng(0)
    blade = [(2500 + rng.normal(0, 2, (64, 80))).astype(np.uint16) for _ in range(5)]
    result = run([*(image(i) for i in range(20)), *blade, *(image(i) for i in range(30, 40))])
    assert [s.shutter for s in result] == [OPEN] * 20 + [CLOSED] * 5 + [JUST_OPENED] + [OPEN] * 9
    assert result[20].reason == "the image shows nothing but noise"


def test_bare_wall_is_no_shutter_for_long():
    rng = np.random.default_rng(0)
    wall = [(2500 + rng.normal(0, 2, (64, 80))).astype(np.uint16) for _ in range(60)]
    stamps = 10**18 + np.arange(80) * 200 * MS
    result = states([*(image(i) for i in range(20)), *wall], stamps)
    assert CLOSED in result[20:46]
    assert set(result[50:]) == {OPEN}


@pytest.mark.parametrize("even", [True, False])
def test_closure_between_two_frames(even):
    """Where a photo flight has no period, what happens between two photos hides nothing; the pattern is new all the same."""
    picture = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 1, (300, 300)), (0, 0), 3) * 400
    patterns = np.random.default_rng(1).normal(0, 4, (2, 128, 160))
    images = [
        (3000 + picture[i : i + 128, 2 * i : 2 * i + 160] + patterns[int(i >= 30)] + np.random.default_rng(i).normal(0, 3, (128, 160))).astype(np.uint16)
        for i in range(40)
    ]
    stamps = 10**18 + np.arange(40) * (40 * MS if even else 2 * 10**9)
    result = run(images, stamps)
    assert [i for i, s in enumerate(result) if s.recalibrated] == [30]
    assert [s.shutter for s in result] == [OPEN] * 30 + [JUST_OPENED if even else OPEN] + [OPEN] * 9
    assert "pattern changed" in result[30].reason


def test_disabled():
    assert states([image(0)] * 4, config=ShutterConfig(enabled=False)) == [OPEN] * 4


@pytest.mark.slow
def test_recordings(shared_data):
    for folder in sorted(path.parent for path in shared_data.glob("*/images.txt")):
        detector = ShutterDetector(ShutterConfig())
        result = [detector.update(frame) for frame in open_recording(folder).frames()]
        assert [s.recalibrated for s in result if s.shutter is JUST_OPENED] == [True] * sum(s.shutter is JUST_OPENED for s in result)
        closed = [s.stamp_ns for s in result if s.shutter is CLOSED]
        if not (folder / "shutter.txt").exists():
            assert all(s.shutter is OPEN for s in result), folder.name
            continue
        period = float(np.median(np.diff([s.stamp_ns for s in result])))
        opened = [s.stamp_ns for s in result if s.shutter is JUST_OPENED]
        closures = np.loadtxt(folder / "shutter.txt", ndmin=2) * 1e9
        assert len(opened) == len(closures)
        begins = [t for t in closed if t - period not in closed and not any(abs(t - period - other) < period / 2 for other in closed)]
        np.testing.assert_allclose(begins, closures[:, 0], atol=2 * period)
        np.testing.assert_allclose(opened, closures[:, 1], atol=2 * period)


@pytest.mark.slow
@pytest.mark.parametrize("evenly", [False, True], ids=["gap", "no trace in the stamps"])
def test_recording_without_its_frozen_frames(shared_data, evenly):
    """The closures are found by the gap they leave, and where frames are numbered and not timed, by the sensor's new pattern."""
    folder = shared_data / "sim_room_shutter"
    closures = np.loadtxt(folder / "shutter.txt", ndmin=2) * 1e9
    frames = [f for f in open_recording(folder).frames() if not any(begin <= f.stamp_ns < end for begin, end in closures)]
    stamps = [10**18 + i * 100 * MS if evenly else f.stamp_ns for i, f in enumerate(frames)]
    detector = ShutterDetector(ShutterConfig())
    result = [detector.update(Frame(stamp, i, f.image)) for i, (stamp, f) in enumerate(zip(stamps, frames, strict=True))]
    after = [next(i for i, f in enumerate(frames) if f.stamp_ns >= end) for _, end in closures]
    assert [i for i, s in enumerate(result) if s.shutter is JUST_OPENED] == after
    assert all(s.shutter is not CLOSED for s in result)
