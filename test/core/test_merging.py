"""Two maps of one world become one; maps of two worlds do not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import CAMERA, FakeExtractor, FakeMatcher, look, loop, observe, room, stamp
from test_slam import CONFIG, ate, frames, make, play

from thegra_core.config import LoopConfig
from thegra_core.geometry import poses
from thegra_core.geometry.similarity import Similarity
from thegra_core.map.editor import MapEditor
from thegra_core.map.map import Map
from thegra_core.mapping.merging import MapMerger
from thegra_core.messages import Keyframe, TrackingState
from thegra_core.outputs.trajectory import live_trajectory
from thegra_core.places.index import PlaceIndex
from thegra_core.slam import Slam

WORLD = room(1500)
PATH = loop(110, turns=1.0)
JUMP = [*PATH[:35], *PATH[60:], *PATH[:15]]
"""A third of a circle, then far ahead on it, on to its end, which is its beginning."""


@pytest.fixture(scope="module")
def merged() -> tuple[list, object, Slam]:
    slam = make(WORLD, JUMP)
    return *play(slam, frames(len(JUMP))), slam


def test_two_maps_of_one_world_become_one(merged) -> None:
    results, run, _ = merged
    assert {r.map_id for r in results if r.state is TrackingState.TRACKING} == {0, 1}, "a second map was needed"
    assert (len(run.maps), run.merges, run.main_map_id) == (1, 1, 0)
    error, placed = ate(run, JUMP)
    assert error < 0.005 and placed > len(JUMP) - 8
    assert results[-1].map_id == 0 and results[-1].state is TrackingState.TRACKING


def test_live_poses_of_the_lost_map_are_not_mixed_with_the_others(merged) -> None:
    _, run, _ = merged
    live = live_trajectory(run, 0)
    assert len(live.stamps_ns) == sum(r.result.map_id == 0 and r.result.state is TrackingState.TRACKING for r in run.frames)


def test_tracking_and_mapping_agree_after_a_merge(merged) -> None:
    slam = merged[2]
    replica, owner = slam._tracking._place.map, slam._mapping.maps()[0]
    assert replica.keyframes.keys() == owner.keyframes.keys()
    for i, keyframe in owner.keyframes.items():
        np.testing.assert_array_equal(replica.keyframes[i].world_from_camera, keyframe.world_from_camera)
        np.testing.assert_array_equal(replica.keyframes[i].landmark_ids, keyframe.landmark_ids)
    np.testing.assert_array_equal(replica.landmarks.alive_ids(), owner.landmarks.alive_ids())
    np.testing.assert_array_equal(replica.landmarks.get(owner.landmarks.alive_ids()).points_world, owner.landmarks.get(owner.landmarks.alive_ids()).points_world)
    assert replica.covisibility == owner.covisibility


def test_maps_of_two_worlds_stay_two() -> None:
    other = room(1500, seed=7)
    first = {stamp(i): pose for i, pose in enumerate(PATH[:30])}
    second = {stamp(i): pose for i, pose in enumerate(PATH[:40], start=30)}

    class Both:
        name = "both"

        def extract(self, image: np.ndarray, stamp_ns: int):
            world, path = (WORLD, first) if stamp_ns in first else (other, second)
            return FakeExtractor(world, path).extract(image, stamp_ns)

    _, run = play(Slam(CAMERA, CONFIG, Both(), FakeMatcher()), frames(70))
    assert (len(run.maps), run.merges) == (2, 0)


# ---- absorbing ------------------------------------------------------------------------------------------------------------------


def small_map(map_id: int, first_keyframe: int, world_from: Similarity) -> MapEditor:
    """Two keyframes and their common points, seen through a similarity of the world."""
    editor = MapEditor(map_id, CAMERA, covisibility_threshold=15)
    landmark_of: dict[int, int] = {}
    for k, position in enumerate(((0, 0, 0), (0.3, 0, 0))):
        pose, keyframe_id = look(position), first_keyframe + k
        features = observe(WORLD, pose, stamp(keyframe_id), noise_px=0.0)
        ids = np.full(len(features), -1, np.int64)
        editor.add_keyframe(Keyframe(keyframe_id, stamp(keyframe_id), (world_from @ Similarity(pose)).rigid, features, ids, -1, map_id))
        for feature, point in enumerate(np.argmax(features.descriptors @ WORLD.descriptors.T, axis=1).tolist()):
            if point not in landmark_of:
                landmark_of[point] = int(editor.add_landmarks(world_from.apply(WORLD.points[None, point]), keyframe_id)[0])
            editor.observe(landmark_of[point], keyframe_id, feature)
    editor.remove_landmarks([i for i in list(editor.observers) if len(editor.observers[i]) < 2])
    for k in range(2):
        editor.connect(first_keyframe + k)
    editor.take_update()
    return editor


vectors = st.lists(st.floats(-2, 2), min_size=3, max_size=3)


@settings(deadline=None, max_examples=20)
@given(vectors, vectors, st.floats(0.2, 5.0))
def test_an_absorbed_map_fits_the_images_as_before(rotation: list[float], shift: list[float], scale: float) -> None:
    new_from_old = Similarity(poses.transform(poses.so3_exp(np.array(rotation)), shift), scale)
    old, new = small_map(0, 0, Similarity(np.eye(4))), small_map(1, 2, new_from_old)
    count, theirs = len(old.map.landmarks), len(new.map.landmarks)
    renamed = old.absorb(new, new_from_old.inverse())
    assert len(renamed) == theirs and len(old.map.landmarks) == count + theirs
    for keyframe in old.map.keyframes.values():
        seen = np.flatnonzero(keyframe.landmark_ids >= 0)
        points = old.map.landmarks.points_world[old.map.landmarks.rows(keyframe.landmark_ids[seen])]
        seen_at = poses.apply(keyframe.camera_from_world, points)
        np.testing.assert_allclose(seen_at[:, :2] / seen_at[:, 2:], keyframe.normalized[seen], atol=1e-5)
        for feature in seen.tolist():
            assert old.observers[int(keyframe.landmark_ids[feature])][keyframe.id] == feature


def test_the_update_after_absorbing_is_the_whole_map() -> None:
    old, new = small_map(0, 0, Similarity(np.eye(4))), small_map(1, 2, Similarity(np.eye(4), 2.0))
    old.absorb(new, Similarity(np.eye(4), 0.5))
    update = old.take_update()
    replica = Map(0, CAMERA)
    replica.apply(update)
    assert sorted(replica.keyframes) == [0, 1, 2, 3] == sorted(replica.covisibility)
    np.testing.assert_array_equal(replica.landmarks.alive_ids(), old.map.landmarks.alive_ids())


def test_a_tie_takes_two_keyframes_of_the_same_map() -> None:
    """What one keyframe of a map saw is no word for the next map, when the first was given up in between."""
    config = CONFIG.model_copy(update={"loop": LoopConfig(vocabulary_keyframes=2, words=16)})
    old, index = small_map(0, 0, Similarity(np.eye(4))), PlaceIndex(config.loop, seed=0)
    for i, keyframe in old.map.keyframes.items():
        index.add(i, keyframe.features)
    others = {0: (old.map, index)}
    merger = MapMerger(config, FakeMatcher())
    given_up, later = small_map(1, 2, Similarity(np.eye(4), 2.0)), small_map(2, 10, Similarity(np.eye(4), 0.5))
    assert merger.find(given_up.map, 2, others) is None
    assert merger.find(later.map, 10, others) is None
    tie = merger.find(later.map, 11, others)
    assert tie is not None and tie.old_map_id == 0 and [s.keyframe_id for s in tie.sightings] == [10, 11]
    assert tie.old_from_new(later.map).scale == pytest.approx(2.0, rel=0.01)
