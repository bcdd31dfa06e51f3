"""The check that places are told apart: what it makes of scenes that differ, and of scenes that do not."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from synthetic import CAMERA, FakeMatcher, World, loop, observe, room, stamp

from thegra_core.config import load_config
from thegra_core.errors import ConfigError
from thegra_core.evaluation.benchmark import joining, kidnapping, places
from thegra_core.evaluation.benchmark.joining import Part
from thegra_core.evaluation.benchmark.settings import Settings
from thegra_core.messages import Features, Frame
from thegra_core.sources.joined import Clip

PATH = loop(110)[:20]
ROOM, OTHER = room(1500), room(1500, seed=7)
CONFIG = load_config("quality", overrides={"preprocessing.filters": "[]", "loop.rotations": "[]"})


@dataclass
class ByImage:
    """Features by what the image holds, whenever and however often it comes."""

    scenes: dict[bytes, tuple[World, np.ndarray]]
    name: str = "fake"

    def extract(self, image: np.ndarray, stamp_ns: int) -> Features:
        world, pose = self.scenes[image.tobytes()]
        return observe(world, pose, stamp_ns, noise_px=0.3, seen=0.9, clutter=10)


def scene(name: str, world: World, seed: int) -> tuple[Clip, dict[bytes, tuple[World, np.ndarray]]]:
    width, height = CAMERA.image_size
    rng = np.random.default_rng(seed)
    frames = [Frame(stamp(i), i, rng.integers(0, 256, (height, width), dtype=np.uint8)) for i in range(len(PATH))]
    return Clip(name, CAMERA, tuple(frames)), {f.image.tobytes(): (world, pose) for f, pose in zip(frames, PATH, strict=True)}


def made(other: World) -> tuple[dict[str, Clip], Settings]:
    one, two = scene("one", ROOM, 1), scene("two", other, 2)
    return {"one": one[0], "two": two[0]}, Settings(CONFIG, ByImage(one[1] | two[1]), FakeMatcher())


def test_what_is_joined() -> None:
    assert [joining.title(p) for p in joining.planned(["a", "b", "c"], ("pairs", "back"))] == ["a + b", "a + c", "b + c", "a + a back", "b + b back", "c + c back"]
    assert [joining.title(p) for p in joining.planned(["a", "b", "c"], ("between",))] == ["a + b + a back", "b + c + b back", "c + a + c back"]
    assert [joining.title(p) for p in joining.planned(["a", "b"], ("turned",))] == ["a + a turn + a back turned", "b + b turn + b back turned"]
    assert joining.planned(["a"], ("pairs", "between")) == []
    with pytest.raises(ConfigError, match="--check loops"):
        places.Plan(("pairs", "loops"))


def test_scenes_that_differ_are_right(tmp_path: Path) -> None:
    clips, settings = made(OTHER)
    content = places.benchmark(clips, places.Plan(trials=3, shown=5), settings, tmp_path, lambda _: None)
    assert places.wrong(content) == []
    pair, back, _, between, _ = content["joined"]
    assert (pair["maps"], pair["false_poses"], pair["found_again_pct"], pair["verdict"]) == (2, 0, None, "right")
    assert (back["maps"], back["losses"], back["verdict"]) == (1, 0, "right") and back["found_again_pct"] > 90 and back["apart"] < 0.02
    assert between["verdict"] == "right" and between["found_again_pct"] > 50
    first, _ = content["kidnapped"]
    assert (first["map"], first["found"], first["elsewhere"], first["lost"], first["claims"]) == ("one", 3, 0, 0, {"two": []})
    assert json.loads((tmp_path / "results.json").read_text(encoding="utf-8")) == content
    written = (tmp_path / "results.md").read_text(encoding="utf-8")
    assert "| one + two back |" not in written and "| one + one back |" in written and "| one | 3 / 3 | 0 |" in written and "Wrong" not in written


def test_a_scene_that_is_another_one_is_told(tmp_path: Path) -> None:
    """The second recording shows the first one's room: to the system, and to anyone else, they are one place."""
    clips, settings = made(ROOM)
    content = places.benchmark(clips, places.Plan(("pairs", "kidnapped"), trials=2, shown=5), settings, tmp_path, lambda _: None)
    (pair,) = content["joined"]
    assert pair["false_poses"] >= 16 and pair["verdict"] == "wrong: two scenes in one map"
    claims = content["kidnapped"][0]["claims"]["two"]
    assert len(claims) >= 3 and all(0 < agree <= visible for agree, visible in claims)
    assert [line.rpartition(":")[0] for line in places.wrong(content)] == ["one + two: wrong", "two in the map of one", "one in the map of two"]
    assert "Wrong: one + two" in places.markdown(content)


def test_a_place_that_is_not_found_again_is_told() -> None:
    """The way back shows another scene under the same name."""
    clips, settings = made(OTHER)
    assert isinstance(settings.extractor, ByImage)
    plan = (Part("one"), Part("one", "back"))
    elsewhere = Clip("one", CAMERA, clips["two"].frames)
    joined = joining.join([clips["one"], elsewhere.backwards()])
    told = joining.judge(joining.run(joined, settings), plan, joined)
    assert (told["found_again_pct"], told["apart"], told["verdict"]) == (0.0, None, "wrong: not found again")


def test_a_kidnapped_camera_that_is_found_elsewhere_is_told(tmp_path: Path) -> None:
    clips, settings = made(OTHER)
    place = kidnapping.known_place(clips["one"], settings, tmp_path / "one.map")
    assert place is not None and 6 <= len(place.unseen()) <= 10
    assert kidnapping.kidnap(place, 3, settings) == [True] * 3
    moved = kidnapping.KnownPlace(place.clip, place.file, {i: position + 1.0 for i, position in place.positions.items()})
    assert kidnapping.kidnap(moved, 3, settings) == [False] * 3
    lost = kidnapping.KnownPlace(clips["two"], place.file, place.positions)
    assert kidnapping.kidnap(lost, 1, settings) == [None]


def test_a_clip_that_makes_no_map_is_told(tmp_path: Path) -> None:
    clips, settings = made(OTHER)
    still = Clip("still", CAMERA, clips["one"].frames[:1] * 6)
    content = {"frames": {"still": 6}, "joined": [], "kidnapped": list(kidnapping.benchmark([still], 2, 2, settings, lambda _: None))}
    assert places.wrong(content) == ["no map of still"]
