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
from thegra_core.messages import NO_LANDMARK, Features, Keyframe
from thegra_core.places.descriptor import as_vectors, describe, learn_vocabulary
from thegra_core.places.index import PlaceIndex
from thegra_core.places.verification import Sighting, agree, sight

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
