"""Places found again by a camera that has turned: descriptors that know up from down, and the image turned back."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import CAMERA, FakeMatcher, look, make_world, observe, stamp
from test_slam import ate, play

from thegra_core.config import ThegraConfig, load_config
from thegra_core.features.registry import make_frame_matcher
from thegra_core.features.turning import TurningMatcher, turned_features, turned_pixels
from thegra_core.mapping.mapper import Mapper
from thegra_core.mapping.service import InlineMapping
from thegra_core.messages import Features, Frame, MapUpdate, Matches, TrackingState
from thegra_core.slam import Slam

WIDTH, HEIGHT = CAMERA.image_size


@dataclass
class Spots:
    """Finds the bright pixels of a dark image; their brightness is their descriptor."""

    name: str = "spots"

    def extract(self, image: np.ndarray, stamp_ns: int) -> Features:
        rows, columns = np.nonzero(image)
        descriptors = np.eye(256, dtype=np.float32)[image[rows, columns]]
        keypoints = np.stack([columns, rows], axis=1).astype(np.float32)
        return Features(stamp_ns, keypoints, np.ones(len(rows), np.float32), descriptors, (image.shape[1], image.shape[0]), self.name)


def spotted() -> np.ndarray:
    image = np.zeros((40, 60), np.uint8)
    rng = np.random.default_rng(0)
    cells = rng.choice(40 * 60, 100, replace=False)
    image.ravel()[cells] = np.arange(1, 101)
    return image


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_features_of_a_turned_image_are_told_at_upright_pixels(turns: int) -> None:
    image = spotted()
    found = turned_features(image, 7, turns, Spots())
    assert (len(found), found.turns, found.image_size, found.stamp_ns) == (100, turns, (60, 40), 7)
    x, y = found.keypoints.astype(int).T
    np.testing.assert_array_equal(image[y, x], found.descriptors.argmax(axis=1))
    back = turned_pixels(turned_pixels(found.keypoints, turns, (60, 40)), -turns, (40, 60) if turns % 2 else (60, 40))
    np.testing.assert_array_equal(back, found.keypoints)


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_the_matcher_is_shown_what_was_found(turns: int) -> None:
    """It sees the turned image's pixels and size, whatever the upright ones are."""
    image, shown = spotted(), []

    class Watching(FakeMatcher):
        def match(self, query: Features, reference: Features) -> Matches:
            shown.append((query, reference))
            return super().match(query, reference)

    query, reference = turned_features(image, 7, turns, Spots()), Spots().extract(image, 3)
    matcher = TurningMatcher(Watching())
    matches = matcher.match(query, reference)
    (same,) = matcher.match_many(query, [reference])
    assert len(matches) == 100 and (matches.stamp_ns, matches.reference_stamp_ns) == (7, 3)
    np.testing.assert_array_equal(matches.indices, same.indices)
    np.testing.assert_array_equal(query.keypoints[matches.indices[:, 0]], reference.keypoints[matches.indices[:, 1]])
    turned = Spots().extract(np.rot90(image, turns), 7)
    assert shown[0][0].image_size == turned.image_size and shown[0][1].image_size == (60, 40)
    np.testing.assert_array_equal(shown[0][0].keypoints, turned.keypoints)


# ---- a camera that looks at the ground ----------------------------------------------------------------------------------------------

_MARK = 60
GROUND = make_world(np.random.default_rng(4).uniform((-4, -4, 3.2), (12, 4, 4.8), (2500, 3)), seed=4)


def turns_of(image: np.ndarray) -> int:
    """By how many quarter turns counter-clockwise an image was turned whose mark was at the upper left."""
    corners = [image[:_MARK, :_MARK], image[:_MARK, -_MARK:], image[-_MARK:, -_MARK:], image[-_MARK:, :_MARK]]
    return -int(np.argmax([c.mean() for c in corners])) % 4


def told_as_found(upright: Features, turns: int) -> Features:
    """Features with the pixels that they have in the image turned by so many quarter turns."""
    there = np.rot90(np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH), turns)
    position = np.empty((HEIGHT * WIDTH, 2))
    position[there.ravel()] = np.indices(there.shape)[::-1].reshape(2, -1).T
    whole = np.clip(np.round(upright.keypoints).astype(int), 0, (WIDTH - 1, HEIGHT - 1))
    keypoints = position[whole[:, 1] * WIDTH + whole[:, 0]].astype(np.float32)
    return replace(upright, keypoints=keypoints, image_size=(there.shape[1], there.shape[0]))


@dataclass
class GroundExtractor:
    """Features of the ground whose descriptors are others for each quarter that the camera has turned; a bright corner tells how the image was turned."""

    path: list[np.ndarray]
    name: str = "ground"
    _turned: list[np.ndarray] = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(5)
        others = rng.normal(size=(3, *GROUND.descriptors.shape)).astype(np.float32)
        self._turned = [GROUND.descriptors, *(others / np.linalg.norm(others, axis=2, keepdims=True))]

    def extract(self, image: np.ndarray, stamp_ns: int) -> Features:
        turns = turns_of(image)
        pose = self.path[(stamp_ns - stamp(0)) // (stamp(1) - stamp(0))]
        quarter = (round(np.degrees(np.arctan2(pose[1, 0], pose[0, 0])) / 90) + turns) % 4
        upright = observe(replace(GROUND, descriptors=self._turned[quarter]), pose, stamp_ns, seen=0.9, clutter=10)
        if turns == 0:
            return upright
        return told_as_found(upright, turns)


def marked_frames(count: int) -> list[Frame]:
    frames = []
    for i in range(count):
        image = np.random.default_rng(i).integers(0, 120, (HEIGHT, WIDTH)).astype(np.uint8)
        image[:_MARK, :_MARK] = 255
        frames.append(Frame(stamp(i), i, image))
    return frames


def there_and_back(count: int) -> list[np.ndarray]:
    """Along x, then half a turn about the optical axis at once, and back over the same ground."""
    there = [look((0.08 * i, 0.02 * np.sin(i), 0.0)) for i in range(count)]
    back = [look((0.08 * i + 0.02, 0.1, 0.0), roll_deg=180) for i in range(count - 1, -1, -1)]
    return [*there, *back]


def config(rotations: str) -> ThegraConfig:
    return load_config("quality", overrides={"preprocessing.filters": "[]", "loop.rotations": rotations, "tracking.mask_fixed_pattern": "false"})


@pytest.mark.parametrize(("rotations", "maps", "losses"), [("[90, 180]", 1, 0), ("[]", 2, 1)])
def test_a_camera_that_turns_round_stays_in_its_map(rotations: str, maps: int, losses: int, tmp_path: Path) -> None:
    path = there_and_back(26)
    slam = Slam(CAMERA, config(rotations), GroundExtractor(path), FakeMatcher())
    results, run = play(slam, marked_frames(len(path)))
    assert (len(run.maps), run.losses) == (maps, losses)
    if rotations == "[]":
        return
    assert {r.state for r in results[26:]} == {TrackingState.TRACKING}
    error, placed = ate(run, path)
    assert error < 0.01 and placed == len(path)
    slam.save_map(tmp_path / "turned.map")
    again = Mapper(CAMERA, config(rotations), FakeMatcher())
    kept = again.load(tmp_path / "turned.map").new_keyframes
    assert {k.features.turns for k in kept if k.stamp_ns < stamp(26)} == {0}
    assert {k.features.turns for k in kept if k.stamp_ns >= stamp(26)} == {2}


# ---- a turn that is filmed ----------------------------------------------------------------------------------------------------------

FIELD = make_world(np.random.default_rng(6).uniform((-4, -4, 3.6), (10, 9, 4.4), (4000, 3)), seed=6)


@dataclass
class FieldExtractor:
    """Features of a field as networks see it: as the camera turns, descriptors change little by little, and points come and go.

    Of the directions in which things can lie in an image each point shows in half of them.
    """

    path: list[np.ndarray]
    name: str = "field"
    asked: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(7)
        across = rng.normal(size=FIELD.descriptors.shape)
        across -= (across * FIELD.descriptors).sum(axis=1, keepdims=True) * FIELD.descriptors
        self._across = (across / np.linalg.norm(across, axis=1, keepdims=True)).astype(np.float32)
        self._best = rng.uniform(-np.pi, np.pi, len(FIELD.points))

    def extract(self, image: np.ndarray, stamp_ns: int) -> Features:
        turns = turns_of(image)
        self.asked.append(turns)
        pose = self.path[(stamp_ns - stamp(0)) // (stamp(1) - stamp(0))]
        lies = np.arctan2(pose[1, 0], pose[0, 0]) + np.pi / 2 * turns
        shows = np.cos(self._best - lies) > 0
        descriptors = (np.cos(lies) * FIELD.descriptors + np.sin(lies) * self._across).astype(np.float32)
        seen = replace(FIELD, points=FIELD.points[shows], descriptors=descriptors[shows], scores=FIELD.scores[shows])
        return told_as_found(observe(seen, pose, stamp_ns, seen=0.9, clutter=10), turns)


class LooseMatcher(FakeMatcher):
    """Matches what looks more alike than things do that lie turned by 45 degrees."""

    def match(self, query: Features, reference: Features) -> Matches:
        similarity = query.descriptors @ reference.descriptors.T
        best = similarity.argmax(axis=1)
        rows = np.flatnonzero((similarity.max(axis=1) > 0.71) & (similarity.argmax(axis=0)[best] == np.arange(len(query))))
        indices = np.stack([rows, best[rows]], axis=1).astype(np.int32)
        return Matches(query.stamp_ns, reference.stamp_ns, indices, similarity[rows, best[rows]].astype(np.float32))


def round_the_end(radius: float, turn: int = 15, along: int = 14, over: int = 16) -> list[np.ndarray]:
    """Along x, a half turn that is filmed, the same way back beside it, and then over to where it began."""
    there = [look((0.2 * i, 0.02 * np.sin(i), 0.0)) for i in range(along)]
    end = 0.2 * along
    curve = [look((end + radius * np.sin(a), radius * (1 - np.cos(a)), 0.0), roll_deg=np.degrees(a)) for a in np.linspace(0, np.pi, turn + 1)]
    back = [look((end - 0.2 * i, 2 * radius + 0.02 * np.sin(i), 0.0), roll_deg=180) for i in range(1, along)]
    return [*there, *curve, *back, *(look((0.2, 2 * radius * (1 - i / over), 0.0), roll_deg=180) for i in range(over + 1))]


@pytest.mark.parametrize(("rotations", "loops"), [("[90, 180, 270]", 1), ("[]", 0)])
def test_after_a_turn_that_is_filmed_images_lie_as_before(rotations: str, loops: int) -> None:
    """Beyond what the way there has seen, and back to it: only where images lie alike a loop closes."""
    path = round_the_end(2.5)
    extractor = FieldExtractor(path)
    slam = Slam(CAMERA, config(rotations), extractor, LooseMatcher())
    results, run = play(slam, marked_frames(len(path)))
    assert (len(run.maps), run.losses, min(run.loops, 1)) == (1, 0, loops)
    assert {r.state for r in results[4:]} == {TrackingState.TRACKING}
    error, _ = ate(run, path)
    assert error < 0.002
    upright = sum(turns == 0 for turns in extractor.asked)
    assert upright == len(path) if rotations == "[]" else upright < 35
    assert len(extractor.asked) <= len(path) + 4, "the other orientation is not looked for in vain"


class LateMapping(InlineMapping):
    """Answers some looks of tracking later; there are two a frame."""

    def __init__(self, mapper: Mapper, looks: int = 3) -> None:
        super().__init__(mapper)
        self._waiting: list[list[MapUpdate]] = [[] for _ in range(looks)]

    def updates(self, patience_s: float = 0.0) -> list[MapUpdate]:
        self._waiting.append(super().updates())
        return self._waiting.pop(0)

    def finish(self) -> list[MapUpdate]:
        late, self._waiting = [update for part in self._waiting for update in part], []
        return [*late, *super().finish()]


def on_the_spot(along: int, turn: int) -> list[np.ndarray]:
    """Along x, a half turn that is filmed, and back."""
    there = [look((0.15 * i, 0.02 * np.sin(i), 0.0)) for i in range(along)]
    turning = [look((0.15 * along, 0.02 * i, 0.0), roll_deg=180 * i / turn) for i in range(turn)]
    return [*there, *turning, *(look((0.15 * i, 0.3, 0.0), roll_deg=180) for i in range(along, 0, -1))]


def test_images_are_turned_back_while_mapping_is_behind() -> None:
    path = on_the_spot(12, 18)
    extractor, settings = FieldExtractor(path), config("[90, 180, 270]")
    slam = Slam(CAMERA, settings, extractor, LooseMatcher(), mapping=LateMapping(Mapper(CAMERA, settings, make_frame_matcher(settings, LooseMatcher()))))
    results, run = play(slam, marked_frames(len(path)))
    assert (len(run.maps), run.losses, run.relocalizations) == (1, 0, 0)
    assert {r.state for r in results[8:]} == {TrackingState.TRACKING}
    assert extractor.asked[-10:] == [2] * 10
    assert ate(run, path)[0] < 0.005


def test_a_map_that_stays_as_it_is_turns_images_back(tmp_path: Path) -> None:
    path = on_the_spot(12, 18)
    first = Slam(CAMERA, config("[90, 180, 270]"), FieldExtractor(path), LooseMatcher())
    for frame in marked_frames(13):
        first.process(frame)
    first.save_map(tmp_path / "field.map")
    extractor = FieldExtractor(path)
    slam = Slam(CAMERA, config("[90, 180, 270]"), extractor, LooseMatcher())
    slam.load_map(tmp_path / "field.map")
    slam.localization_only = True
    results = [slam.process(frame) for frame in marked_frames(len(path))]
    assert {r.state for r in results} == {TrackingState.TRACKING}
    assert extractor.asked[-10:] == [2] * 10
    assert slam.map_size()[0] == len(Mapper(CAMERA, config("[]"), LooseMatcher()).load(tmp_path / "field.map").new_keyframes)
