"""Places found again by a camera that has turned: descriptors that know up from down, and the image turned back."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from synthetic import CAMERA, FakeMatcher, look, make_world, observe, stamp
from test_places import place_map
from test_slam import ate, play

from thegra_core.config import LoopConfig, ThegraConfig, load_config
from thegra_core.mapping.chaining import MatchGraph
from thegra_core.mapping.loop_closing import LoopCloser
from thegra_core.messages import Features, Frame, TrackingState, TurnedView
from thegra_core.places.turning import TurnedMatcher, turn_back, turned_view
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


@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
def test_turned_pixels_come_back(quarter_turns: int) -> None:
    image = spotted()
    turned = Spots().extract(np.rot90(image, quarter_turns), 0)
    x, y = turn_back(turned.keypoints, quarter_turns, (60, 40)).astype(int).T
    np.testing.assert_array_equal(image[y, x], turned.descriptors.argmax(axis=1))


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
def test_matches_of_a_turned_view_are_told_in_upright_keypoints(quarter_turns: int) -> None:
    image, extractor = spotted(), Spots()
    upright = extractor.extract(image, 7)
    kept = np.arange(0, len(upright), 2)
    upright = replace(upright, keypoints=upright.keypoints[kept], scores=upright.scores[kept], descriptors=upright.descriptors[kept])
    view = turned_view(image, upright, quarter_turns, extractor)
    found = view.upright[view.upright >= 0]
    assert len(found) == len(set(found.tolist())) >= 40, "one upright keypoint each"
    reference = extractor.extract(image, 3)
    matches = TurnedMatcher(FakeMatcher(), view).match(upright, reference)
    (same,) = TurnedMatcher(FakeMatcher(), view).match_many(upright, [reference])
    np.testing.assert_array_equal(matches.indices, same.indices)
    assert (np.diff(matches.indices[:, 0]) > 0).all() and (matches.stamp_ns, matches.reference_stamp_ns) == (7, 3)
    exact = np.linalg.norm(upright.keypoints[matches.indices[:, 0]] - reference.keypoints[matches.indices[:, 1]], axis=1)
    assert len(matches) >= 40 and exact.max() <= 2.0 and np.mean(exact == 0) > 0.8


def test_images_that_show_nothing_have_turned_views_too() -> None:
    nothing = Spots().extract(np.zeros((40, 60), np.uint8), 0)
    for image in (np.zeros((40, 60), np.uint8), spotted()):
        assert (turned_view(image, nothing, 1, Spots()).upright == -1).all()


# ---- a camera that looks at the ground ----------------------------------------------------------------------------------------------

_MARK = 60
GROUND = make_world(np.random.default_rng(4).uniform((-4, -4, 3.2), (12, 4, 4.8), (2500, 3)), seed=4)


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
        corners = [image[:_MARK, :_MARK], image[:_MARK, -_MARK:], image[-_MARK:, -_MARK:], image[-_MARK:, :_MARK]]
        turns = -int(np.argmax([c.mean() for c in corners])) % 4  # the mark is at the upper left of an upright image
        pose = self.path[(stamp_ns - stamp(0)) // (stamp(1) - stamp(0))]
        quarter = (round(np.degrees(np.arctan2(pose[1, 0], pose[0, 0])) / 90) - turns) % 4
        upright = observe(replace(GROUND, descriptors=self._turned[quarter]), pose, stamp_ns, seen=0.9, clutter=10)
        if turns == 0:
            return upright
        index = np.indices((HEIGHT, WIDTH))[::-1].reshape(2, -1).T
        there = np.rot90(np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH), turns)
        position = np.empty((HEIGHT * WIDTH, 2))
        position[there.ravel()] = np.indices(there.shape)[::-1].reshape(2, -1).T
        whole = np.round(upright.keypoints).astype(int)
        keypoints = position[whole[:, 1] * WIDTH + whole[:, 0]].astype(np.float32)
        assert len(index) == len(position)
        return replace(upright, keypoints=keypoints, image_size=(there.shape[1], there.shape[0]))


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


@pytest.mark.parametrize(("rotations", "maps", "losses"), [("[180]", 1, 0), ("[]", 2, 1)])
def test_a_camera_that_turns_round_stays_in_its_map(rotations: str, maps: int, losses: int) -> None:
    path = there_and_back(30)
    slam = Slam(CAMERA, config(rotations), GroundExtractor(path), FakeMatcher())
    results, run = play(slam, marked_frames(len(path)))
    assert (len(run.maps), run.losses) == (maps, losses)
    if rotations != "[]":
        assert {r.state for r in results[30:]} == {TrackingState.TRACKING}
        error, placed = ate(run, path)
        assert error < 0.01 and placed == len(path)


@pytest.mark.parametrize("with_views", [True, False])
def test_a_loop_is_closed_by_turned_views(with_views: bool) -> None:
    """A place seen again with descriptors that have turned with the camera."""
    editor, _ = place_map(scale=1.1, shift=(0.2, -0.1, 0.1))
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(32, 32)))[0].astype(np.float32)
    loops, graph = LoopCloser(config("[180]").model_copy(update={"loop": LoopConfig(vocabulary_keyframes=3, words=16, similarity_share=0.5)}), FakeMatcher()), MatchGraph()
    views = {}
    for keyframe_id in (0, 1, 2, 10, 11):
        keyframe = editor.map.keyframes[keyframe_id]
        if keyframe_id >= 10:
            views[keyframe_id] = [TurnedView(keyframe.features, np.arange(len(keyframe.features)))] if with_views else []
            keyframe.features = replace(keyframe.features, descriptors=keyframe.features.descriptors @ turn)
        loops.index.add(keyframe_id, keyframe.features)
    assert not loops.look(editor, 10, graph, views[10]), "a loop takes two"
    assert loops.look(editor, 11, graph, views[11]) == with_views
    assert loops.closed == int(with_views)
