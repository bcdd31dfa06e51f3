"""Places seen again in real and simulated recordings: a camera that is set down somewhere in a map, and one that goes back all the way."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_recordings import PATIENCE_S, needs

from thegra_core.config import load_config
from thegra_core.features.registry import make_extractor, make_matcher
from thegra_core.messages import Frame, TrackingState
from thegra_core.slam import Slam
from thegra_core.sources.open import camera_for, open_recording

TRIALS = 20
PATIENCE_FRAMES = 15


def recorded(path: Path) -> tuple[object, list[Frame]]:
    """Camera and frames of a recording."""
    needs(path, "quality")
    recording = open_recording(path, None, None)
    return camera_for(recording, None), list(recording.frames())


def later(frames: list[Frame], begin_ns: int, period_ns: int) -> Iterator[Frame]:
    """The frames in their order at stamps of their own."""
    for i, frame in enumerate(frames):
        yield replace(frame, stamp_ns=begin_ns + i * period_ns, index=frame.index + 100_000)


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S)
@pytest.mark.parametrize(("name", "frames_used"), [("sim_room_shutter", 60), ("kitchen_rgb_7scenes", 66), ("forest_f0", 40)])
def test_a_kidnapped_camera_is_found(shared_data: Path, tmp_path: Path, name: str, frames_used: int) -> None:
    """A map of every other frame; the camera is set down at frames that the map has not seen, and must be found where their neighbours are."""
    camera, frames = recorded(shared_data / name)
    frames, every = frames[:frames_used], 2
    config = load_config("quality")
    extractor, matcher = make_extractor(config.extractor), make_matcher(config.matcher, config.extractor)
    slam = Slam(camera, config, extractor, matcher)
    seen = frames[::every]
    for frame in seen:
        slam.process(frame)
    slam.save_map(tmp_path / "place.map")
    run = slam.finish()
    placed = {f.stamp_ns: f.world_from_camera for f in run.frames if f.world_from_camera is not None and f.map_id == run.main_map_id}
    period_ns = int(np.median(np.diff([f.stamp_ns for f in frames])))
    rng = np.random.default_rng(0)
    inside = [i for i in range(1, len(frames) - 1, every) if frames[i - 1].stamp_ns in placed and frames[i + 1].stamp_ns in placed]
    found = 0
    for start in rng.choice(inside, TRIALS):
        slam = Slam(camera, config, extractor, matcher)
        slam.load_map(tmp_path / "place.map")
        slam.localization_only = True
        unseen = frames[start::every][:PATIENCE_FRAMES]
        for offset, frame in enumerate(later(unseen, frames[-1].stamp_ns + 3_000_000_000, period_ns)):
            result = slam.process(frame)
            if result.state is TrackingState.TRACKING:
                before, after = (placed.get(frames[start + offset * every + step].stamp_ns) for step in (-1, 1))
                assert before is not None and after is not None and result.world_from_camera is not None
                position, ends = result.world_from_camera[:3, 3], (before[:3, 3], after[:3, 3])
                # between its neighbours, in units of the scene's depth, which is 1 at the start of a map
                assert np.linalg.norm(position - 0.5 * (ends[0] + ends[1])) < 0.5 * np.linalg.norm(ends[1] - ends[0]) + 0.05
                found += 1
                break
    assert found >= 0.9 * TRIALS


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S)
@pytest.mark.parametrize("name", ["kitchen_rgb_7scenes", "forest_f0", "forest_f6_line1"])
def test_the_way_back_stays_in_one_map(shared_data: Path, name: str) -> None:
    """There and back again: every place is seen twice, and the end is the beginning."""
    camera, there = recorded(shared_data / name)
    period_ns = int(np.median(np.diff([f.stamp_ns for f in there])))
    back = later(there[-2::-1], there[-1].stamp_ns + period_ns, period_ns)
    slam = Slam(camera, load_config("quality"))
    for frame in [*there, *back]:
        slam.process(frame)
    run = slam.finish()
    poses = {f.index: f.world_from_camera for f in run.frames if f.world_from_camera is not None}
    assert len(run.maps) == 1
    depth = 1.0  # the median depth of a new map
    beginning, end = poses[there[0].index], poses[there[0].index + 100_000]
    assert np.linalg.norm(beginning[:3, 3] - end[:3, 3]) < 0.05 * depth, "the way back ends where the way there began"


def of_size(frames: list[Frame], size: tuple[int, int]) -> list[Frame]:
    """The middle of each image, with its edge repeated where the image is too small."""
    made = []
    for frame in frames:
        image = frame.image
        for axis, wanted in ((0, size[1]), (1, size[0])):
            spare = image.shape[axis] - wanted
            if spare > 0:
                image = np.take(image, np.arange(spare // 2, spare // 2 + wanted), axis=axis)
            elif spare < 0:
                width = [(0, 0), (0, 0)]
                width[axis] = (-spare // 2, -spare - -spare // 2)
                image = np.pad(image, width, mode="edge")
        made.append(replace(frame, image=np.ascontiguousarray(image)))
    return made


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S)
@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("forest_f0", "forest_f6_line1"),  # two forests without leaves
        ("forest_f6_line1", "orchard_m2ea_drone"),
        ("kitchen_rgb_7scenes", "sim_room_shutter"),  # two rooms
        ("sim_room_shutter", "forest_f0"),
        ("sim_corridor_loop", "sim_rotation_only"),
    ],
)
def test_two_places_in_one_recording_stay_two(shared_data: Path, one: str, other: str) -> None:
    camera, first = recorded(shared_data / one)
    second = of_size(recorded(shared_data / other)[1], camera.image_size)
    if second[0].image.dtype != first[0].image.dtype:
        first, second = ([replace(f, image=f.image.astype(np.float32)) for f in part] for part in (first, second))
    period_ns = int(np.median(np.diff([f.stamp_ns for f in first])))
    border_ns = first[-1].stamp_ns + period_ns
    slam = Slam(camera, load_config("quality"))
    for frame in [*first, *later(second, border_ns, period_ns)]:
        slam.process(frame)
    run = slam.finish()
    assert run.merges == 0
    for each in run.maps:
        beyond = each.keyframe_stamps_ns >= border_ns
        assert beyond.all() or not beyond.any(), "a map of two places"
