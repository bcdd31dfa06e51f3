"""New landmarks: each acceptance test by itself, and what happens to matches whose keypoints see landmarks already."""

from __future__ import annotations

import numpy as np
import pytest

from thegra_core.config import MappingConfig
from thegra_core.geometry import poses
from thegra_core.geometry.camera import CameraModel, DistortionModel
from thegra_core.map.editor import MapEditor
from thegra_core.map.map import MapKeyframe, make_keyframes
from thegra_core.mapping.expansion import accept_points, expand
from thegra_core.messages import NO_LANDMARK, Features, Keyframe, Matches

FOCAL = 500.0
CAMERA = CameraModel(np.array([[FOCAL, 0, 320], [0, FOCAL, 256], [0, 0, 1]]), np.zeros(5), DistortionModel.PLUMB_BOB, (640, 512))
CONFIG = MappingConfig()


def message(keyframe_id: int, pose: np.ndarray, pixels: np.ndarray) -> Keyframe:
    count = len(pixels)
    features = Features(keyframe_id, pixels.astype(np.float32), np.ones(count, np.float32), np.eye(count, 16, dtype=np.float32), (640, 512), "fake")
    return Keyframe(keyframe_id, keyframe_id, pose, features, np.full(count, NO_LANDMARK, np.int64), -1, 0)


def pair(points: np.ndarray, second: np.ndarray | None = None, shift_px: np.ndarray | None = None) -> tuple[MapKeyframe, MapKeyframe]:
    """Keyframes 1 (at the origin) and 0 (one unit to the right) that see the points; `shift_px` moves the keypoints of keyframe 0."""
    pose = poses.transform(np.eye(3), [1.0, 0, 0]) if second is None else second
    first_pixels = points[:, :2] / points[:, 2:] * FOCAL + [320, 256]
    moved = poses.apply(poses.inverse(pose), points)
    second_pixels = moved[:, :2] / moved[:, 2:] * FOCAL + [320, 256] + (0 if shift_px is None else shift_px)
    first, second = make_keyframes([message(1, np.eye(4), first_pixels), message(0, pose, second_pixels)], CAMERA)
    return first, second


def accepted(keyframe: MapKeyframe, neighbour: MapKeyframe, config: MappingConfig = CONFIG) -> list[bool]:
    rows = np.arange(len(keyframe.features))
    return accept_points(keyframe, neighbour, rows, rows, FOCAL, config)[1].tolist()


def test_a_good_point_is_accepted_where_it_is() -> None:
    truth = np.array([[0.5, 0.2, 6.0], [-0.5, 0.4, 10.0]])
    keyframe, neighbour = pair(truth)
    points, good = accept_points(keyframe, neighbour, np.arange(2), np.arange(2), FOCAL, CONFIG)
    assert good.all()
    np.testing.assert_allclose(points, truth, atol=1e-3)


def test_epipolar_distance() -> None:
    """Sideways motion: the line is a row; sampson halves the error between the views, so 2 px are 2.83 px in one."""
    truth = np.tile([0.5, 0.2, 6.0], (3, 1))
    lenient = MappingConfig(max_reprojection_px=100.0)
    assert accepted(*pair(truth, shift_px=np.array([[0, 2.7], [0, 2.95], [2.95, 0.0]])), config=lenient) == [True, False, True]


def test_reprojection_error_in_both_views() -> None:
    """With the epipolar test out of the way the two views share the error; each must stay within 2 px."""
    truth = np.tile([0.5, 0.2, 6.0], (2, 1))
    lenient = MappingConfig(epipolar_px=100.0)
    assert accepted(*pair(truth, shift_px=np.array([[0, 3.5], [0, 4.5]])), config=lenient) == [True, False]
    # a neighbour ten times nearer to the point takes nearly all of the error itself
    near = poses.transform(np.eye(3), [0.45, 0, 5.4])
    assert accepted(*pair(np.array([[0.5, 0.2, 6.0]]), second=near, shift_px=np.array([[0, 0.0]])), config=MappingConfig(max_scale_ratio=100)) == [True]


def test_depth_must_be_positive_in_both() -> None:
    """Rays that meet behind the cameras (disparity of the wrong sign) and rays that meet behind one of them."""
    keyframe, neighbour = pair(np.array([[0.5, 0.2, 6.0]]), shift_px=np.array([[2 * FOCAL / 6.0, 0.0]]))
    assert accepted(keyframe, neighbour) == [False]
    backwards = poses.transform(poses.so3_exp([0, np.pi, 0]), [1.0, 0, 1.0])  # looks the other way: the point has negative depth there
    points = np.array([[0.5, 0.2, 6.0]])
    assert accepted(*pair(points, second=backwards)) == [False]


@pytest.mark.parametrize(("depth", "expected"), [(1 / np.radians(1.02), True), (1 / np.radians(0.98), False)])
def test_parallax(depth: float, expected: bool) -> None:
    assert accepted(*pair(np.array([[0.5, 0.0, depth]]))) == [expected]


@pytest.mark.parametrize(("ratio", "expected"), [(3.9, True), (4.1, False)])
def test_scale(ratio: float, expected: bool) -> None:
    """A neighbour that is `ratio` times nearer to the point."""
    point = np.array([[0.3, 0.0, 8.0]])
    near = poses.transform(np.eye(3), [0.6, 0.0, 0.0])
    near[:3, 3] += (point[0] - [0.6, 0, 0]) * (1 - np.linalg.norm(point) / ratio / np.linalg.norm(point[0] - [0.6, 0, 0]))
    assert accepted(*pair(point, second=near)) == [expected]


def test_without_a_baseline_nothing_is_accepted() -> None:
    points = np.array([[0.5, 0.2, 6.0], [0.1, 0.1, 3.0]])
    assert accepted(*pair(points, second=np.eye(4))) == [False, False]
    keyframe, neighbour = pair(points)
    assert accept_points(keyframe, neighbour, np.empty(0, np.int64), np.empty(0, np.int64), FOCAL, CONFIG)[1].shape == (0,)


# ---- joins and fusions ---------------------------------------------------------------------------------------------------------------

TRUTH = np.array([[0.5, 0.2, 6.0], [-0.5, 0.4, 8.0], [0.1, -0.6, 7.0], [0.9, 0.1, 5.0]])
ALL = Matches(1, 0, np.stack([np.arange(4), np.arange(4)], axis=1).astype(np.int32), np.ones(4, np.float32))


@pytest.fixture
def editor() -> MapEditor:
    """Keyframes 1 and 0 as in `pair`, and a third one further right that sees the same four points."""
    editor = MapEditor(0, CAMERA, 3)
    for keyframe_id, x in ((0, 1.0), (1, 0.0), (2, 2.0)):
        pose = poses.transform(np.eye(3), [x, 0, 0])
        moved = poses.apply(poses.inverse(pose), TRUTH)
        editor.add_keyframe(message(keyframe_id, pose, moved[:, :2] / moved[:, 2:] * FOCAL + [320, 256]))
    return editor


def known(editor: MapEditor, point: int, views: list[int], offset: float = 0.0) -> int:
    landmark = int(editor.add_landmarks(TRUTH[point : point + 1] + [0, offset, 0], 0)[0])
    for keyframe_id in views:
        editor.observe(landmark, keyframe_id, point)
    return landmark


def test_free_matches_become_landmarks(editor: MapEditor) -> None:
    assert expand(editor, 1, 0, ALL, CONFIG) == 4
    assert editor.map.keyframes[1].landmark_ids.tolist() == editor.map.keyframes[0].landmark_ids.tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(editor.map.landmarks.points_world, TRUTH, atol=1e-3)
    assert expand(editor, 1, 0, ALL, CONFIG) == 0, "a second time nothing is new"


@pytest.mark.parametrize("seeing", [0, 1])
def test_the_other_side_joins(editor: MapEditor, seeing: int) -> None:
    landmark = known(editor, 2, [seeing, 2])
    assert expand(editor, 1, 0, ALL, CONFIG) == 3
    assert editor.observers[landmark] == {0: 2, 1: 2, 2: 2}


def test_a_landmark_whose_depth_is_still_wrong_is_joined_at_the_point_that_all_agree_on(editor: MapEditor) -> None:
    landmark = known(editor, 2, [0, 2], offset=0.1)  # 7 px off
    assert expand(editor, 1, 0, ALL, CONFIG) == 3
    assert editor.observers[landmark] == {0: 2, 1: 2, 2: 2}
    np.testing.assert_allclose(editor.map.landmarks.points_world[editor.map.landmarks.rows(np.array([landmark]))[0]], TRUTH[2], atol=1e-3)


def test_a_landmark_that_no_point_reconciles_with_its_match_is_not_joined_and_the_match_makes_no_point(editor: MapEditor) -> None:
    landmark = int(editor.add_landmarks(TRUTH[2:3] + [0, 0.1, 0], 0)[0])
    editor.observe(landmark, 0, 2)
    editor.observe(landmark, 2, 3)  # another point's keypoint
    assert expand(editor, 1, 0, ALL, CONFIG) <= 3
    assert editor.observers[landmark] == {0: 2, 2: 3}
    assert editor.map.keyframes[1].landmark_ids[2] == NO_LANDMARK


def test_two_landmarks_of_one_point_are_fused_into_the_better_observed(editor: MapEditor) -> None:
    dropped, kept = known(editor, 1, [0]), known(editor, 1, [1, 2])
    editor.visible[kept], editor.found[kept] = 9, 4
    assert expand(editor, 1, 0, ALL, CONFIG) == 3
    assert dropped not in editor.observers
    assert editor.observers[kept] == {0: 1, 1: 1, 2: 1}
    assert (editor.visible[kept], editor.found[kept]) == (10, 5)
    assert editor.map.keyframes[2].landmark_ids[1] == kept


def test_what_two_landmarks_of_one_ray_become_explains_its_observations(editor: MapEditor) -> None:
    """Keyframe 0 sees a point that lies much too far out on its ray; keyframes 1 and 2 see the true one. Both reproject in keyframe 0, so they are fused:
    the survivor must be where everybody sees it."""
    far = TRUTH[1] + 0.6 * (TRUTH[1] - [1.0, 0, 0])
    editor.observe(int(editor.add_landmarks(far[None], 0)[0]), 0, 1)
    known(editor, 1, [1, 2])
    expand(editor, 1, 0, ALL, CONFIG)
    landmark = int(editor.map.keyframes[2].landmark_ids[1])
    point = editor.map.landmarks.get(np.array([landmark])).points_world
    for keyframe_id, feature in editor.observers[landmark].items():
        keyframe = editor.map.keyframes[keyframe_id]
        pixel = CAMERA.project(poses.apply(keyframe.camera_from_world, point))[0]
        assert np.linalg.norm(pixel - keyframe.features.keypoints[feature]) < CONFIG.max_reprojection_px


def test_undefined_keypoints_are_left_out(editor: MapEditor) -> None:
    editor.map.keyframes[0].normalized[1] = np.nan
    assert expand(editor, 1, 0, ALL, CONFIG) == 3
    assert editor.map.keyframes[1].landmark_ids[1] == NO_LANDMARK


def test_no_matches(editor: MapEditor) -> None:
    assert expand(editor, 1, 0, Matches(1, 0, np.empty((0, 2), np.int32), np.empty(0, np.float32)), CONFIG) == 0
