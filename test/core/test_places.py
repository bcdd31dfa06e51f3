"""Places: their vectors, the index, and whether two keyframes see the same one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import CAMERA, FakeMatcher, look, make_world, observe, room, stamp

from thegra_core.config import LoopConfig, ThegraConfig
from thegra_core.geometry import poses
from thegra_core.geometry.similarity import Similarity
from thegra_core.map.editor import MapEditor
from thegra_core.messages import NO_LANDMARK, Features, Keyframe, Matches
from thegra_core.places.descriptor import as_vectors, describe, learn_vocabulary
from thegra_core.places.index import PlaceIndex
from thegra_core.places.verification import Sighting, agree, drift_of, sight

CONFIG = ThegraConfig()
WORLD = room(seed=3)


def view(yaw_deg, index, position=(0.0, 0.0, 0.0)):
    return observe(WORLD, look(position, yaw_deg), stamp(index), seen=0.7, clutter=30)


def test_a_place_looks_like_itself_from_nearby():
    vocabulary = learn_vocabulary([view(yaw, i) for i, yaw in enumerate(range(0, 360, 45))], 32, seed=0)
    vectors = np.stack([describe(view(yaw, 20 + i, (0.1, 0, 0)), vocabulary) for i, yaw in enumerate(range(0, 360, 90))])
    again = np.stack([describe(view(yaw, 40 + i), vocabulary) for i, yaw in enumerate(range(0, 360, 90))])
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, rtol=1e-5)
    similarity = vectors @ again.T
    assert (similarity.argmax(axis=1) == np.arange(4)).all()
    assert np.diag(similarity).min() > 2 * (similarity - np.diag(np.diag(similarity))).max()


def test_vocabulary_is_the_same_each_time():
    images = [view(yaw, yaw) for yaw in (0, 90)]
    np.testing.assert_array_equal(learn_vocabulary(images, 16, seed=4), learn_vocabulary(images, 16, seed=4))


def test_binary_descriptors_compare_by_their_bits():
    bits = np.array([[0b10110000] * 4, [0b10110001] * 4, [0b01001111] * 4], np.uint8)
    vectors = as_vectors(Features(0, np.zeros((3, 2), np.float32), np.ones(3, np.float32), bits, (9, 9), "orb"))
    np.testing.assert_allclose(vectors @ vectors.T, [[1, 0.75, -1], [0.75, 1, -0.75], [-1, -0.75, 1]], atol=1e-6)


def test_image_without_keypoints_has_a_vector():
    nothing = replace(view(0, 0), keypoints=np.empty((0, 2), np.float32), scores=np.empty(0, np.float32), descriptors=np.empty((0, 32), np.float32))
    assert not describe(nothing, learn_vocabulary([view(0, 0)], 8, seed=0)).any()


def test_index_gives_places_seen_before_and_nothing_else():
    index = PlaceIndex(LoopConfig(vocabulary_keyframes=4, words=32), seed=0)
    yaws = [*range(0, 360, 15), 2, 17]
    for i, yaw in enumerate(yaws):
        index.add(i, view(yaw, i))
        if i < 3:
            assert index.query(view(yaw, i), 3) == []
            assert index.candidates(i, [0]) == []
    assert set(index.query(view(17, 25), 99)) == set(range(26))
    found = index.candidates(25, [24, 23])
    assert found[0] == 1
    assert set(found) <= {0, 1, 2, 3}
    assert index.candidates(12, [11, 13, 10, 14, 9, 15]) == []
    assert index.candidates(12, []) == []


def test_a_removed_keyframe_is_found_no_more_and_the_others_as_before():
    index, whole = (PlaceIndex(LoopConfig(vocabulary_keyframes=4, words=32), seed=0) for _ in range(2))
    yaws = list(range(0, 360, 30))
    for i, yaw in enumerate(yaws):
        for one in (index, whole):
            one.add(i, view(yaw, i))
    for gone in (3, 11, 5, 99):
        index.remove(gone)
    left = [i for i in whole.query(view(92, 50), 99) if i not in (3, 11, 5)]
    assert index.query(view(92, 50), 99) == left
    index.add(30, view(91, 51))
    assert index.query(view(92, 50), 1) == [30]
    again = PlaceIndex(LoopConfig(), seed=0)
    again.restore(index.arrays(), {})
    assert again.query(view(92, 50), 99) == index.query(view(92, 50), 99)
    waiting = PlaceIndex(LoopConfig(vocabulary_keyframes=4, words=32), seed=0)
    for i in range(3):
        waiting.add(i, view(30 * i, i))
    waiting.remove(1)
    waiting.add(3, view(90, 3))
    assert waiting.query(view(0, 9), 9) == [], "three are too few for words"


def place_map(scale=1.0, shift=(0.0, 0.0, 0.0)):
    """Two parts of a map that see the same wall: keyframes 0 to 2, and 10 and 11, which have drifted by a scale and a shift."""
    editor = MapEditor(0, CAMERA, covisibility_threshold=15)
    drift = Similarity(poses.transform(poses.so3_exp([0, 0.02, 0]), shift), scale)
    truth = {0: look((0, 0, 0)), 1: look((0.3, 0, 0)), 2: look((0.6, 0, 0)), 10: look((0.15, 0.05, 0.1), 2), 11: look((0.45, 0.05, 0.1), -2)}
    landmark_of = {}
    for keyframe_id, pose in truth.items():
        features = observe(WORLD, pose, stamp(keyframe_id), noise_px=0.3)
        which = np.argmax(features.descriptors @ WORLD.descriptors.T, axis=1)
        part = Similarity(np.eye(4)) if keyframe_id < 10 else drift
        placed = part @ Similarity(pose)
        editor.add_keyframe(Keyframe(keyframe_id, stamp(keyframe_id), placed.rigid, features, np.full(len(features), NO_LANDMARK, np.int64), -1, 0))
        for feature, point in enumerate(which.tolist()):
            key = (keyframe_id >= 10, point)
            if key not in landmark_of:
                landmark_of[key] = int(editor.add_landmarks(part.apply(WORLD.points[None, point]), keyframe_id)[0])
            editor.observe(landmark_of[key], keyframe_id, feature)
    editor.remove_landmarks([i for i in list(editor.observers) if len(editor.observers[i]) < 2])
    for keyframe_id in truth:
        editor.connect(keyframe_id)
    editor.refresh()
    return editor, truth


def test_sighting_finds_pose_and_scale():
    editor, truth = place_map(scale=1.25, shift=(0.4, -0.2, 0.3))
    found = sight(editor.map, 10, editor.map, [0, 1, 2], FakeMatcher(wrong=0.2), CONFIG)
    assert isinstance(found, Sighting)
    assert found.world_from_camera.scale == pytest.approx(1 / 1.25, rel=0.01)
    np.testing.assert_allclose(found.world_from_camera.rigid, truth[10], atol=0.01)
    assert len(found.keypoints) == len(set(found.landmarks.tolist())) > CONFIG.loop.min_inliers
    other = sight(editor.map, 11, editor.map, [1, 2], FakeMatcher(), CONFIG)
    assert isinstance(other, Sighting)
    assert agree(editor.map, found, other, CONFIG)
    turned = replace(other, world_from_camera=Similarity(other.world_from_camera.rigid @ look((0, 0, 0), 6), other.world_from_camera.scale))
    assert not agree(editor.map, found, turned, CONFIG)
    assert not agree(editor.map, found, replace(other, world_from_camera=Similarity(other.world_from_camera.rigid, 1.0)), CONFIG)
    assert not agree(editor.map, found, replace(other, world_from_camera=Similarity(other.world_from_camera.rigid @ look((1, 0, 0)), 0.8)), CONFIG)


def test_another_place_is_refused_with_the_reason():
    editor, _ = place_map()
    elsewhere = observe(make_world(WORLD.points, seed=99), look((0, 0, 0)), stamp(50))
    editor.add_keyframe(Keyframe(50, stamp(50), look((0, 0, 0)), elsewhere, np.full(len(elsewhere), NO_LANDMARK, np.int64), -1, 0))
    assert sight(editor.map, 50, editor.map, [0], FakeMatcher(), CONFIG) == "0 matches"
    assert "inliers of" in str(sight(editor.map, 10, editor.map, [0], FakeMatcher(wrong=1.0), CONFIG))


def test_a_keyframe_without_landmarks_of_its_own_tells_no_scale():
    editor, _ = place_map()
    bare = observe(WORLD, look((0.1, 0, 0)), stamp(60))
    editor.add_keyframe(Keyframe(60, stamp(60), look((0.1, 0, 0)), bare, np.full(len(bare), NO_LANDMARK, np.int64), -1, 0))
    assert sight(editor.map, 60, editor.map, [0, 1], FakeMatcher(), CONFIG) == "0 landmarks of both places"


def test_a_few_agreeing_landmarks_of_many_that_should_be_seen_are_no_place():
    """A building that repeats itself: a fifth of the matches fit one pose well, and the rest of what should be there is not."""
    editor, _ = place_map()
    strict = CONFIG.model_copy(update={"loop": CONFIG.loop.model_copy(update={"min_inliers": 10, "min_matches": 10})})
    assert isinstance(sight(editor.map, 10, editor.map, [0, 1, 2], FakeMatcher(), strict), Sighting)
    features = editor.map.keyframes[10].features
    few = np.arange(0, len(features), 12)
    some = replace(features, keypoints=features.keypoints[few], scores=features.scores[few], descriptors=features.descriptors[few])
    editor.add_keyframe(Keyframe(70, stamp(70), editor.map.keyframes[10].world_from_camera, some, editor.map.keyframes[10].landmark_ids[few], -1, 0))
    told = sight(editor.map, 70, editor.map, [0, 1, 2], FakeMatcher(), strict)
    assert isinstance(told, str) and "should be seen from there" in told


def test_no_network_is_asked_about_what_has_other_descriptors():
    editor, _ = place_map()
    screened = CONFIG.model_copy(update={"loop": CONFIG.loop.model_copy(update={"min_nearest": 10})})
    elsewhere = observe(make_world(WORLD.points, seed=99), look((0, 0, 0)), stamp(50))
    editor.add_keyframe(Keyframe(50, stamp(50), look((0, 0, 0)), elsewhere, np.full(len(elsewhere), NO_LANDMARK, np.int64), -1, 0))
    matcher = FakeMatcher()
    assert "by nearest descriptors" in str(sight(editor.map, 50, editor.map, [0, 1, 2], matcher, screened))
    assert matcher.calls == 0
    assert isinstance(sight(editor.map, 10, editor.map, [0, 1, 2], matcher, screened), Sighting)
    assert matcher.calls == 3


def test_neighbours_are_not_matched_where_the_candidate_places_nothing():
    editor, _ = place_map()
    matcher = FakeMatcher(wrong=1.0)
    assert "of the candidate" in str(sight(editor.map, 10, editor.map, [0, 1, 2], matcher, CONFIG))
    assert matcher.calls == 1


def straight_map(count: int, step: float) -> MapEditor:
    editor = MapEditor(0, CAMERA, 15)
    nothing = replace(view(0, 0), keypoints=np.empty((0, 2), np.float32), scores=np.empty(0, np.float32), descriptors=np.empty((0, 32), np.float32))
    for i in range(count):
        editor.add_keyframe(Keyframe(i, stamp(i), look((i * step, 0, 0)), replace(nothing, stamp_ns=stamp(i)), np.empty(0, np.int64), -1, 0))
    return editor


def seen_at(pose, scale=1.0):
    empty = np.empty(0, np.int64)
    return Sighting(20, Similarity(pose, scale), empty, empty, {2: Matches(0, 0, np.empty((0, 2), np.int32), np.empty(0, np.float32))}, 0)


@pytest.mark.parametrize(
    ("where", "yaw_deg", "scale", "expected"),
    [
        ((20.0, 0, 0), 0, 1.0, True),
        ((16.6, 0, 0), 0, 1.0, True),  # 3.4 of a way of 18: under a fifth
        ((16.2, 0, 0), 0, 1.0, False),
        ((16.2, 0, 0), 0, 0.8, True),  # and a drift of scale by 0.8 may move it by 2 more
        ((2.0, 0, 0), 0, 1.0, False),  # what is seen is where the way began: a corridor with equal doors
        ((20.0, 0, 0), 19, 1.0, True),
        ((20.0, 0, 0), 90, 1.0, False),
    ],
)
def test_a_loop_corrects_drift_and_no_more(where, yaw_deg, scale, expected):
    current = straight_map(21, 1.0).map
    drift = drift_of(current, seen_at(look(where, yaw_deg), scale))
    assert drift.is_possible(CONFIG.loop) is expected
    assert drift.turned_deg == pytest.approx(yaw_deg, abs=1e-6) and drift.moved_ratio == pytest.approx(abs(20 - where[0]) / 18)
