"""Any sequence of changes keeps the map consistent in both directions and its replica equal."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from thegra_core.geometry import poses
from thegra_core.geometry.camera import CameraModel, DistortionModel
from thegra_core.geometry.similarity import Similarity
from thegra_core.map.editor import MapEditor
from thegra_core.map.map import Map
from thegra_core.messages import NO_LANDMARK, Features, Keyframe

CAMERA = CameraModel(np.diag([300.0, 300.0, 1.0]), np.zeros(5), DistortionModel.PLUMB_BOB, (640, 512))
KEYPOINTS, THRESHOLD = 12, 3


def keyframe(keyframe_id: int, landmark_ids: np.ndarray | None = None, count: int = KEYPOINTS) -> Keyframe:
    rng = np.random.default_rng(keyframe_id)
    descriptors = rng.normal(size=(count, 8)).astype(np.float32)
    features = Features(
        1000 * keyframe_id, rng.uniform(0, 500, (count, 2)).astype(np.float32), rng.uniform(0.1, 1, count).astype(np.float32), descriptors, (640, 512), "fake"
    )
    ids = np.full(count, NO_LANDMARK, np.int64) if landmark_ids is None else landmark_ids
    return Keyframe(keyframe_id, 1000 * keyframe_id, poses.transform(np.eye(3), rng.normal(size=3)), features, ids, keyframe_id - 1, 0)


class Editing(RuleBasedStateMachine):
    """Random changes to a map of few keyframes, so that every collision happens."""

    def __init__(self) -> None:
        super().__init__()
        self.editor = MapEditor(0, CAMERA, THRESHOLD)
        self.replica = Map(0, CAMERA)
        self.ever: set[int] = set()
        self.version = 0
        self.inheritance: dict[int, np.ndarray] = {}
        self.next_keyframe = 1
        self.editor.add_keyframe(keyframe(0))

    def landmark(self, pick: int) -> int:
        """Any id that was ever given, dead ones too."""
        ids = sorted(self.ever) or [0]
        return ids[pick % len(ids)]

    def camera(self, pick: int) -> int:
        ids = sorted(self.editor.map.keyframes)
        return ids[pick % len(ids)]

    @rule(seed=st.integers(0, 10**6))
    @precondition(lambda self: len(self.editor.map.keyframes) < 8)
    def add_keyframe(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        pool = np.array([*sorted(self.ever), NO_LANDMARK, 10**6], dtype=np.int64)
        ids = np.full(KEYPOINTS, NO_LANDMARK, np.int64)
        chosen = rng.permutation(pool)[:KEYPOINTS]
        ids[: len(chosen)] = chosen
        number = self.next_keyframe
        self.next_keyframe += 1
        self.editor.add_keyframe(keyframe(number, ids))
        self.editor.connect(number)

    @rule(count=st.integers(0, 6), first=st.integers(0, 99), second=st.integers(0, 99), seed=st.integers(0, 999))
    def add_landmarks(self, count: int, first: int, second: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        ids = self.editor.add_landmarks(rng.normal(size=(count, 3)), self.camera(first))
        assert not self.ever & set(ids.tolist()), "an id is never given twice"
        self.ever |= set(ids.tolist())
        for landmark in ids.tolist():
            self.editor.observe(landmark, self.camera(first), int(rng.integers(KEYPOINTS)))
            self.editor.observe(landmark, self.camera(second), int(rng.integers(KEYPOINTS)))

    @rule(landmark=st.integers(0, 99), where=st.integers(0, 99), feature=st.integers(0, KEYPOINTS - 1))
    def observe(self, landmark: int, where: int, feature: int) -> None:
        if self.landmark(landmark) in self.editor.observers:
            self.editor.observe(self.landmark(landmark), self.camera(where), feature)

    @rule(landmark=st.integers(0, 99), where=st.integers(0, 99))
    def forget(self, landmark: int, where: int) -> None:
        chosen, keyframe_id = self.landmark(landmark), self.camera(where)
        held = keyframe_id in self.editor.observers.get(chosen, {})
        self.editor.forget_observation(chosen, keyframe_id)
        if held and chosen in self.editor.observers:
            assert len(self.editor.observers[chosen]) >= 2

    @rule(landmarks=st.lists(st.integers(0, 99), max_size=4))
    def remove(self, landmarks: list[int]) -> None:
        ids = {self.landmark(pick) for pick in landmarks}
        self.editor.remove_landmarks(ids)
        assert not ids & set(self.editor.observers)

    @rule(one=st.integers(0, 99), other=st.integers(0, 99))
    def fuse(self, one: int, other: int) -> None:
        keep, drop = self.landmark(one), self.landmark(other)
        both = keep != drop and keep in self.editor.observers and drop in self.editor.observers
        seen = set(self.editor.observers.get(keep, {})) | set(self.editor.observers.get(drop, {}))
        counts = self.editor.visible[keep] + self.editor.visible[drop], self.editor.found[keep] + self.editor.found[drop]
        self.editor.fuse(keep, drop)
        if both:
            assert drop not in self.editor.observers
            assert set(self.editor.observers[keep]) == seen
            assert (self.editor.visible[keep], self.editor.found[keep]) == counts

    @rule(pick=st.integers(0, 99))
    @precondition(lambda self: len(self.editor.map.keyframes) > 1)
    def remove_keyframe(self, pick: int) -> None:
        chosen = self.camera(pick)
        pose = self.editor.map.keyframes[chosen].world_from_camera
        left = {i: set(seen) - {chosen} for i, seen in self.editor.observers.items()}
        shared = {i for i, seen in self.editor.observers.items() if chosen in seen}
        self.editor.remove_keyframe(chosen)
        assert {i: set(seen) for i, seen in self.editor.observers.items()} == {i: seen for i, seen in left.items() if i not in shared or len(seen) > 1}
        assert all(chosen not in dict(edges) for edges in self.editor.map.covisibility.values())
        self.inheritance[chosen] = pose

    @rule(seed=st.integers(0, 10**6))
    def move(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        keyframe_ids = np.array(sorted(self.editor.map.keyframes))[::2]
        landmarks = np.array([*sorted(self.ever)][::2], dtype=np.int64)
        moved = np.stack([poses.transform(np.eye(3), rng.normal(size=3)) for _ in keyframe_ids])
        self.editor.move(keyframe_ids, moved, landmarks, rng.normal(size=(len(landmarks), 3)))

    @rule(where=st.integers(0, 99))
    def connect(self, where: int) -> None:
        chosen = self.camera(where)
        self.editor.connect(chosen)
        mine = set(self.editor.map.keyframes[chosen].landmark_ids.tolist()) - {NO_LANDMARK}
        shared = {
            i: len(mine & set(k.landmark_ids.tolist())) for i, k in self.editor.map.keyframes.items() if i != chosen and mine & set(k.landmark_ids.tolist())
        }
        strong = {i: n for i, n in shared.items() if n >= THRESHOLD}
        edges = dict(self.editor.map.covisibility[chosen])
        assert self.editor.shared_landmarks(chosen) == Counter(shared)
        if strong:
            assert edges == strong
        elif shared:
            assert len(edges) == 1 and next(iter(edges.values())) == max(shared.values())
        else:
            assert not edges
        for i in self.editor.map.keyframes:
            assert dict(self.editor.map.covisibility.get(i, ())).get(chosen) == edges.get(i), "edges go both ways"

    @rule()
    def send(self) -> None:
        update = self.editor.take_update()
        self.version += 1
        assert update.version == self.version
        self.replica.apply(update)
        original = self.editor.map
        assert sorted(self.replica.keyframes) == sorted(original.keyframes)
        assert {r.id for r in update.removed_keyframes} == set(self.inheritance)
        assert all(r.heir_id in original.keyframes and r.stamp_ns == 1000 * r.id for r in update.removed_keyframes)
        self.inheritance.clear()
        for i, expected in original.keyframes.items():
            found = self.replica.keyframes[i]
            np.testing.assert_array_equal(found.world_from_camera, expected.world_from_camera)
            np.testing.assert_array_equal(found.landmark_ids, expected.landmark_ids)
            np.testing.assert_array_equal(found.normalized, expected.normalized)
            assert not np.shares_memory(found.landmark_ids, expected.landmark_ids)
            assert not np.shares_memory(found.world_from_camera, expected.world_from_camera)
        ids = original.landmarks.alive_ids()
        np.testing.assert_array_equal(self.replica.landmarks.alive_ids(), ids)
        if len(ids):
            mine, theirs = self.replica.landmarks.get(ids), original.landmarks.get(ids)
            for name in mine.__slots__:
                np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name), name)
        assert self.replica.covisibility == original.covisibility
        again = self.editor.take_update()
        self.version += 1
        assert not again.keyframes and again.landmarks is None and len(again.removed_landmark_ids) == 0 and not again.covisibility and not again.new_keyframes
        self.replica.apply(again)
        self.check_newest(ids)

    def check_newest(self, ids: np.ndarray) -> None:
        """Descriptor of the newest observation and mean score of each landmark by hand."""
        for landmark in ids.tolist():
            observers = {i: self.editor.map.keyframes[i].features for i in self.editor.observers[landmark]}
            if observers:
                row, newest = self.editor.map.landmarks.get(np.array([landmark])), max(observers)
                where = self.editor.observers[landmark]
                np.testing.assert_array_equal(row.descriptors[0], observers[newest].descriptors[where[newest]])
                assert row.scores[0] == pytest.approx(np.mean([f.scores[where[i]] for i, f in observers.items()]), rel=1e-5)
                assert 0 <= row.depth_min[0] <= row.depth_max[0] < np.inf

    @invariant()
    def both_directions_agree(self) -> None:
        editor = self.editor
        forward = {
            (int(landmark), i, feature)
            for i, k in editor.map.keyframes.items()
            for feature, landmark in enumerate(k.landmark_ids.tolist())
            if landmark != NO_LANDMARK
        }
        backward = {(landmark, i, feature) for landmark, seen in editor.observers.items() for i, feature in seen.items()}
        assert forward == backward
        np.testing.assert_array_equal(editor.map.landmarks.alive_ids(), sorted(editor.observers))
        assert set(editor.first_keyframe) == set(editor.observers)
        assert {i for i, n in editor.visible.items() if n} <= set(editor.observers)
        asked = np.array([*sorted(editor.observers, reverse=True), 10**6], np.int64)
        table = np.stack(editor.observations(asked), axis=1)
        in_order = [(row, i, feature) for row, landmark in enumerate(asked.tolist()) for i, feature in sorted(editor.observers.get(landmark, {}).items())]
        assert table.tolist() == [list(triple) for triple in in_order]


TestEditing = Editing.TestCase
TestEditing.settings = settings(deadline=None, max_examples=60, stateful_step_count=30)


def test_derived_data_by_hand() -> None:
    editor = MapEditor(0, CAMERA, THRESHOLD)
    for number, x in enumerate((0.0, 3.0)):
        editor.add_keyframe(keyframe(number))
        editor.map.keyframes[number].world_from_camera = poses.transform(np.eye(3), [x, 0, 0])
    (landmark,) = editor.add_landmarks(np.array([[0.0, 0.0, 4.0]]), 1).tolist()
    editor.observe(landmark, 0, 5)
    editor.observe(landmark, 1, 7)
    editor.take_update()
    row = editor.map.landmarks.get(np.array([landmark]))
    assert (row.depth_min[0], row.depth_max[0]) == (4.0, 5.0)
    mean = np.array([0, 0, 1.0]) + np.array([-0.6, 0, 0.8])
    np.testing.assert_allclose(row.normals[0], mean / np.linalg.norm(mean))
    np.testing.assert_array_equal(row.descriptors[0], editor.map.keyframes[1].features.descriptors[7])
    first, second = editor.map.keyframes[0].features.scores[5], editor.map.keyframes[1].features.scores[7]
    assert row.scores[0] == pytest.approx((first + second) / 2)


def test_a_keyframe_brings_only_observations_of_the_living() -> None:
    editor = MapEditor(0, CAMERA, THRESHOLD)
    editor.add_keyframe(keyframe(0))
    editor.add_keyframe(keyframe(1))
    ids = editor.add_landmarks(np.zeros((3, 3)), 1)
    for feature, landmark in enumerate(ids.tolist()):
        editor.observe(landmark, 0, feature)
        editor.observe(landmark, 1, feature)
    editor.remove_landmarks([int(ids[1])])
    wanted = np.full(KEYPOINTS, NO_LANDMARK, np.int64)
    wanted[:5] = [ids[0], ids[1], ids[2], ids[0], 999]  # dead, twice the same, unknown
    editor.add_keyframe(keyframe(2, wanted))
    np.testing.assert_array_equal(editor.map.keyframes[2].landmark_ids[:5], [ids[0], -1, ids[2], -1, -1])


def test_fusing_keeps_one_keypoint_a_keyframe() -> None:
    editor = MapEditor(0, CAMERA, THRESHOLD)
    for number in range(3):
        editor.add_keyframe(keyframe(number))
    keep, drop = editor.add_landmarks(np.zeros((2, 3)), 0).tolist()
    for landmark, views in ((keep, {0: 1, 1: 2}), (drop, {1: 3, 2: 4})):
        for keyframe_id, feature in views.items():
            editor.observe(landmark, keyframe_id, feature)
    editor.fuse(keep, drop)
    assert editor.observers == {keep: {0: 1, 1: 2, 2: 4}}
    assert editor.map.keyframes[1].landmark_ids[3] == NO_LANDMARK
    update = editor.take_update()
    np.testing.assert_array_equal(update.removed_landmark_ids, [drop])


def test_local_keyframes_are_the_neighbours_and_theirs_once_each() -> None:
    current = Map(0, CAMERA)
    current.covisibility = {0: ((1, 9), (2, 8)), 1: ((0, 9), (3, 7), (2, 6)), 2: ((0, 8), (4, 5))}
    assert current.local_keyframes(0, 10) == [0, 1, 2, 3, 4]
    assert current.local_keyframes(0, 4) == [0, 1, 2, 3]
    assert current.local_keyframes(0, 2) == [0, 1]
    assert current.local_keyframes(0, 1) == [0]
    assert current.local_keyframes(9, 5) == [9]


def test_median_depth_is_of_the_living_in_front() -> None:
    editor = MapEditor(0, CAMERA, THRESHOLD)
    editor.add_keyframe(keyframe(0))
    editor.map.keyframes[0].world_from_camera = np.eye(4)
    assert np.isnan(editor.map.median_depth(0))
    for feature, landmark in enumerate(editor.add_landmarks(np.array([[0, 0, z] for z in (1.0, 2.0, 6.0, -5.0, 9.0)]), 0).tolist()):
        editor.observe(landmark, 0, feature)
    editor.remove_landmarks([4])
    assert editor.map.median_depth(0) == 2.0
    assert editor.map.median_depth(0, poses.transform(np.eye(3), [0, 0, -1.0])) == 3.0


def test_the_heir_takes_over_what_is_placed_beside_a_removed_keyframe() -> None:
    """Two that leave one after the other, the first to the second: the last heir tells where both were."""
    editor = MapEditor(0, CAMERA, THRESHOLD)
    for number in range(3):
        editor.add_keyframe(keyframe(number))
    for one, other in ((0, 1), (1, 2)):
        for feature, landmark in enumerate(editor.add_landmarks(np.ones((4, 3)), one).tolist(), start=4 * one):
            editor.observe(landmark, one, feature)
            editor.observe(landmark, other, feature)
    for number in range(3):
        editor.connect(number)
    before = {i: k.world_from_camera for i, k in editor.map.keyframes.items()}
    editor.take_update()
    editor.remove_keyframe(0)
    editor.remove_keyframe(1)
    removed = editor.take_update().removed_keyframes
    assert [(r.id, r.heir_id) for r in removed] == [(0, 2), (1, 2)]
    for r in removed:
        np.testing.assert_allclose(before[2] @ r.heir_from_removed, before[r.id], atol=1e-12)


def test_a_keyframe_on_its_way_when_a_loop_closes_is_moved_with_its_reference() -> None:
    """Tracking placed it in the map as it was; the loop turns the map by 90 degrees, doubles it and shifts it."""
    editor = MapEditor(0, CAMERA, THRESHOLD)
    for i in range(3):
        editor.add_keyframe(keyframe(i))
    known = editor.take_update().version
    turned = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    loop = Similarity(poses.transform(turned, np.array([1.0, 2, 3])), 2.0)
    editor.note_moves({0: Similarity(np.eye(4)), 1: Similarity(np.eye(4)), 2: loop})
    told = editor.take_update().version
    late = replace(keyframe(3), world_from_camera=poses.transform(np.eye(3), np.array([1.0, 0, 0])), map_version=known)
    np.testing.assert_allclose(editor.carried(late).world_from_camera, poses.transform(turned, np.array([1.0, 4, 3])), atol=1e-12)
    np.testing.assert_allclose(editor.carried(replace(late, reference_id=0)).world_from_camera, late.world_from_camera, atol=1e-12)
    np.testing.assert_allclose(editor.carried(replace(late, reference_id=7)).world_from_camera[:3, 3], [1.0, 4, 3], atol=1e-12)
    np.testing.assert_array_equal(editor.carried(replace(late, map_version=told)).world_from_camera, late.world_from_camera)
