"""Places in real and simulated recordings: a camera that is set down somewhere in a map, one that goes back all the way, and one that is carried elsewhere."""

from __future__ import annotations

from pathlib import Path

import pytest
from test_recordings import PATIENCE_S, missing_weights, needs

from thegra_core.config import load_config
from thegra_core.evaluation.benchmark import joining, kidnapping, places
from thegra_core.evaluation.benchmark.joining import Part
from thegra_core.evaluation.benchmark.settings import Settings
from thegra_core.features.registry import make_extractor, make_matcher
from thegra_core.simulation.simulate import SimulationOptions, simulate
from thegra_core.sources.joined import read_clip

TRIALS = 20


def profile(name: str, overrides: dict[str, str] | None = None) -> Settings:
    config = load_config(name, overrides=overrides)
    return Settings(config, make_extractor(config.extractor), make_matcher(config.matcher, config.extractor))


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S)
@pytest.mark.parametrize(("name", "frames_used"), [("sim_room_shutter", 60), ("kitchen_rgb_7scenes", 66), ("forest_f0", 40)])
def test_a_kidnapped_camera_is_found(shared_data: Path, tmp_path: Path, name: str, frames_used: int) -> None:
    """A map of every other frame; the camera is set down at frames that the map has not seen, and must be found where their neighbours are."""
    needs(shared_data / name, "quality")
    settings = profile("quality")
    place = kidnapping.known_place(read_clip(shared_data / name, max_frames=frames_used), settings, tmp_path / "place.map")
    assert place is not None
    told = kidnapping.kidnap(place, TRIALS, settings)
    assert told.count(False) == 0, "found where it is not"
    assert told.count(True) >= places.MIN_FOUND * TRIALS


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S)
@pytest.mark.parametrize(("name", "every"), [("kitchen_rgb_7scenes", 1), ("forest_f0", 1), ("forest_f6_line1", 1), ("sim_corridor_loop", 1), ("sim_room_shutter", 2)])
def test_the_way_back_stays_in_one_map(shared_data: Path, name: str, every: int) -> None:
    """There and back again: every place is seen twice, and is the same place both times."""
    needs(shared_data / name, "quality")
    clip = read_clip(shared_data / name, every)
    told = joining.run_one({name: clip}, (Part(name), Part(name, "back")), 0.0, profile("quality"))
    assert (told["maps"], told["verdict"]) == (1, "right")
    assert told["found_again_pct"] >= 90
    assert told["apart"] < 0.01


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S)
def test_the_way_back_after_a_turn_that_is_filmed_is_the_same_place(shared_data: Path) -> None:
    """A drone turns on the spot and flies back: what it sees is what it saw, upside down."""
    needs(shared_data / "forest_f0", "fast")
    clip = read_clip(shared_data / "forest_f0", max_frames=30)
    (plan,) = joining.planned(["forest_f0"], ("turned",))
    told = {rotations: joining.run_one({"forest_f0": clip}, plan, 0.0, profile("fast", {"loop.rotations": rotations})) for rotations in ("[90, 180, 270]", "[]")}
    with_turns, without = told.values()
    assert (with_turns["maps"], with_turns["tracked_pct"], with_turns["found_again_pct"]) == (1, [100.0, 100.0, 100.0], 100.0)
    assert with_turns["apart"] < 0.01
    assert without["verdict"] != "right", "the recording tells nothing"


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
    for name in (one, other):
        needs(shared_data / name, "quality")
    clips = {name: read_clip(shared_data / name) for name in (one, other)}
    told = joining.run_one(clips, (Part(one), Part(other)), 0.0, profile("quality"))
    assert (told["merges"], told["false_poses"]) == (0, 0)


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE_S)
def test_two_streets_are_told_apart(tmp_path: Path) -> None:
    """Streets have the same cars at their sides: 30 to 40 landmarks of one agree with a pose in the other, a tenth of what should be seen from there."""
    if missing_weights("realtime"):
        pytest.skip(f"NOT TESTED, no weights: {missing_weights('realtime')}")
    folders = []
    for seed, style in ((301, "robust"), (303, "aggressive")):
        options = SimulationOptions.model_validate({"scene": "street", "style": style, "duration_s": 6, "image_size": (320, 256), "seed": seed})
        folders.append(simulate(options, tmp_path / style, "folder"))
    (first, second) = kidnapping.benchmark([read_clip(folder) for folder in folders], TRIALS, 30, profile("realtime"), lambda _: None)
    for told, other in ((first, "aggressive"), (second, "robust")):
        assert told["claims"] == {other: []}
        assert told["found"] >= places.MIN_FOUND * TRIALS and told["elsewhere"] == 0
