"""Full adjustments made apart: who solves them, and what becomes of a map that has grown meanwhile."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import CAMERA, FakeMatcher, look, loop, observe, room, stamp
from test_bundle import CHI2, HUBER, problem
from tracking_pair import CONFIG, Pair

from thegra_core.geometry import poses
from thegra_core.map.editor import MapEditor
from thegra_core.mapping.adjustment import adjust_all, full_adjustment
from thegra_core.mapping.full_adjustment import FullAdjustments, bring_in
from thegra_core.messages import NO_LANDMARK, Keyframe
from thegra_core.optimization.bundle import BundleResult
from thegra_core.optimization.solver import BundleTask, InlineSolver, ProcessSolver

WORLD = room(600)


def grown(editor: MapEditor, keyframe_id: int, pose: np.ndarray, reference_id: int, landmark_of: dict[int, int], disturbed: float = 0.0) -> None:
    """Add a keyframe that sees the world's points, the new ones as new landmarks."""
    features = observe(WORLD, pose, stamp(keyframe_id), noise_px=0.2)
    rng = np.random.default_rng(keyframe_id)
    placed = pose @ poses.transform(poses.so3_exp(rng.normal(0, disturbed, 3)), rng.normal(0, disturbed, 3))
    editor.add_keyframe(Keyframe(keyframe_id, stamp(keyframe_id), placed, features, np.full(len(features), NO_LANDMARK, np.int64), reference_id, 0))
    for feature, point in enumerate(np.argmax(features.descriptors @ WORLD.descriptors.T, axis=1).tolist()):
        if point not in landmark_of:
            landmark_of[point] = int(editor.add_landmarks(WORLD.points[None, point], keyframe_id)[0])
        editor.observe(landmark_of[point], keyframe_id, feature)


def small_map(disturbed: float = 0.0) -> tuple[MapEditor, dict[int, int]]:
    editor, landmark_of = MapEditor(0, CAMERA, covisibility_threshold=15), {}  # type: MapEditor, dict[int, int]
    for i in range(4):
        grown(editor, i, look((0.2 * i, 0, 0)), i - 1, landmark_of, disturbed if i else 0.0)
    for i in range(4):
        editor.connect(i)
    return editor, landmark_of


def test_a_process_finds_what_the_caller_would() -> None:
    task = BundleTask(problem(), HUBER, CHI2, 10, 1e-5)
    here, there = InlineSolver().submit(task), ProcessSolver().submit(task)
    expected, found = here.result(), there.result()
    assert here.ready and there.ready and expected is not None and found is not None
    for name in ("world_from_camera", "points_world", "outliers", "squared_errors"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_a_process_that_fails_is_said_and_gives_nothing(caplog: pytest.LogCaptureFixture) -> None:
    broken = replace(problem(), normalized=np.zeros((1, 2)))
    assert ProcessSolver().submit(BundleTask(broken, HUBER, CHI2, 10, 1e-5)).result() is None
    assert "ended with code 1" in caplog.text


def test_a_cancelled_process_is_gone(caplog: pytest.LogCaptureFixture) -> None:
    pending = ProcessSolver().submit(BundleTask(problem(views=30, count=4000), HUBER, CHI2, 1000, 0.0))
    pending.cancel()
    assert pending.ready and pending.result() is None
    assert not caplog.text, "nothing has failed"


def test_the_result_for_a_map_that_has_not_grown_is_that_of_the_adjustment_at_once() -> None:
    at_once, apart = small_map(disturbed=0.01)[0], small_map(disturbed=0.01)[0]
    adjust_all(at_once, CONFIG)
    adjustment = full_adjustment(apart, CONFIG)
    assert adjustment is not None
    bring_in(apart, adjustment, adjustment.task.solve())
    for i, keyframe in at_once.map.keyframes.items():
        np.testing.assert_array_equal(apart.map.keyframes[i].world_from_camera, keyframe.world_from_camera)
        np.testing.assert_array_equal(apart.map.keyframes[i].landmark_ids, keyframe.landmark_ids)
    np.testing.assert_array_equal(apart.map.landmarks.alive_ids(), at_once.map.landmarks.alive_ids())
    ids = np.array([i for i in at_once.observers if len(at_once.observers[i]) > 1])  # one observation places nothing
    np.testing.assert_array_equal(apart.map.landmarks.get(ids).points_world, at_once.map.landmarks.get(ids).points_world)


def test_what_came_since_is_carried_along() -> None:
    """The result moves the whole snapshot by one rigid motion; the map is then everywhere moved by it, whatever was added, fused or removed."""
    editor, landmark_of = small_map()
    adjustment = full_adjustment(editor, CONFIG)
    assert adjustment is not None
    grown(editor, 4, look((0.8, 0, 0), 20), 3, landmark_of)
    grown(editor, 5, look((1.0, 0, 0), 40), 4, landmark_of)
    seen = editor.map.landmarks.alive_ids()
    gone, fused = int(seen[3]), int(seen[5])
    editor.remove_landmarks([gone])
    editor.fuse(int(seen[6]), fused)
    before = {i: k.world_from_camera.copy() for i, k in editor.map.keyframes.items()}
    ids = editor.map.landmarks.alive_ids()
    points = editor.map.landmarks.get(ids).points_world
    motion = poses.transform(poses.so3_exp([0.1, -0.2, 0.3]), [1.0, 2, 3])
    task = adjustment.task.problem
    outliers = np.zeros(len(task.weights), dtype=bool)
    outliers[0] = True
    result = BundleResult(motion @ task.world_from_camera, poses.apply(motion, task.points_world), outliers, np.zeros(len(outliers)))
    bring_in(editor, adjustment, result)
    for i, pose in before.items():
        np.testing.assert_allclose(editor.map.keyframes[i].world_from_camera, motion @ pose, atol=1e-9)
    left = editor.map.landmarks.rows(ids) >= 0
    assert left.sum() >= len(ids) - 1, "an outlier may cost its landmark"
    np.testing.assert_allclose(editor.map.landmarks.get(ids[left]).points_world, poses.apply(motion, points[left]), atol=1e-9)
    landmark, keyframe_id = int(adjustment.landmark_ids[task.point_index[0]]), int(adjustment.observer[0])
    assert keyframe_id not in editor.observers.get(landmark, {})


def test_a_result_waits_for_its_keyframe() -> None:
    editor, _ = small_map(disturbed=0.01)
    full = FullAdjustments(InlineSolver(), CONFIG)
    pose = editor.map.keyframes[2].world_from_camera.copy()
    assert not full.collect(editor), "nothing is under way"
    full.start(editor)
    for _ in range(CONFIG.loop.full_adjustment_after - 1):
        assert not full.collect(editor)
    np.testing.assert_array_equal(editor.map.keyframes[2].world_from_camera, pose)
    assert full.collect(editor) and not full.collect(editor)
    assert np.abs(editor.map.keyframes[2].world_from_camera - pose).max() > 1e-4
    full.start(editor)
    full.cancel(editor.map.map_id)
    assert not any(full.collect(editor) for _ in range(CONFIG.loop.full_adjustment_after))


def test_tracking_follows_a_process_that_adjusts_a_loop() -> None:
    pair = Pair(CONFIG, FakeMatcher(wrong=0.05), ProcessSolver())
    pair.run(room(count=3000, seed=12), loop(130, turns=1.15), noise_px=1.0)
    assert pair.mapper.loops > 0
    replica, original = pair.tracking._place.map, pair.mapper.map(0)
    assert replica.keyframes.keys() == original.keyframes.keys()
    for i, keyframe in original.keyframes.items():
        np.testing.assert_array_equal(replica.keyframes[i].world_from_camera, keyframe.world_from_camera)
    pair.mapper.finish(0)
