"""Recordings joined to one."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from thegra_core.errors import InputError
from thegra_core.geometry.camera import CameraModel, DistortionModel
from thegra_core.geometry.poses import so3_exp, transform
from thegra_core.messages import Frame
from thegra_core.sources.joined import Clip, View, common_camera, join, read_clip, roll_homography

WIDE = CameraModel(np.array([[60.0, 0, 39.5], [0, 60.0, 31.5], [0, 0, 1]]), np.array([-0.2, 0.05, 0.001, -0.001]), DistortionModel.PLUMB_BOB, (80, 64))
NARROW = CameraModel(np.array([[300.0, 0, 81.0], [0, 300.0, 60.0], [0, 0, 1]]), np.array([0.1, 0, 0, 0]), DistortionModel.PLUMB_BOB, (160, 120))


def clip(name: str, camera: CameraModel = WIDE, count: int = 5, period_ns: int = 100, dtype: type = np.uint16) -> Clip:
    width, height = camera.image_size
    return Clip(name, camera, tuple(Frame(1000 + period_ns * i, 3 * i, np.full((height, width), 10 + i, dtype)) for i in range(count)))


def test_clips_follow_each_other_at_the_pace_of_the_first() -> None:
    there = clip("there")
    joined = join([there, there.backwards(), clip("other", period_ns=7)], gap_s=1e-6)
    begins = np.array([1000 + 100 * i for i in range(14)])
    gaps = np.repeat([0, 1000, 2000], [5, 4, 5])
    assert [f.stamp_ns for f in joined.frames] == (begins + gaps).tolist()
    assert [f.index for f in joined.frames] == list(range(14))
    assert [int(f.image[0, 0]) for f in joined.frames] == [10, 11, 12, 13, 14, 13, 12, 11, 10, 10, 11, 12, 13, 14]
    assert joined.part.tolist() == [0] * 5 + [1] * 4 + [2] * 5
    assert joined.source.tolist() == [0, 3, 6, 9, 12, 9, 6, 3, 0, 0, 3, 6, 9, 12]
    assert joined.camera is WIDE and joined.frames[0].image.dtype == np.uint16


def seen(camera: CameraModel, world_from_camera: np.ndarray) -> np.ndarray:
    """A scene at infinity that is a smooth function of the direction, near the axis at least as wide as the image is high."""
    width, height = camera.image_size
    pixels = np.stack(np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float)), axis=-1).reshape(-1, 2)
    rays = camera.bearings(pixels) @ world_from_camera[:3, :3].T
    x, y = (rays[:, :2] / rays[:, 2:]).T
    return (3000 + 900 * np.sin(9 * x + 0.3) + 700 * np.cos(7 * y + 0.5 * x)).reshape(height, width).astype(np.uint16)


@pytest.mark.parametrize("degrees", [30, 90, 180])
def test_rolled_images_are_what_a_rolled_camera_sees(degrees: float) -> None:
    camera = replace(WIDE, matrix=np.array([[60.0, 0, 41.5], [0, 55.0, 30.0], [0, 0, 1]]), distortion=np.array([-0.2, 0.05, 0.0, 0.0]))
    rolled = so3_exp([0, 0, np.radians(degrees)])  # z is forward, so the camera's right side goes down
    before, after = seen(camera, np.eye(4)), seen(camera, transform(rolled, np.zeros(3)))
    turning = Clip("a", camera, (Frame(0, 0, before),)).turning(30.0)
    image = turning.frames[round(degrees / 30) - 1].image
    y, x = np.mgrid[: before.shape[0], : before.shape[1]]
    round_the_axis = np.hypot((x - 41.5) / 60, (y - 30) / 55) < 0.45
    assert round_the_axis.sum() > 1500
    error = np.abs(image.astype(float) - after)[round_the_axis]
    assert error.max() < 10, "of 3200 between dark and bright"


def test_a_turn_ends_upside_down_and_numbers_images_as_they_were() -> None:
    there = clip("there")
    turn = there.turning()
    assert len(turn.frames) == 18 and {f.index for f in turn.frames} == {there.frames[-1].index}
    round_about = there.upside_down()
    np.testing.assert_array_equal(turn.frames[-1].image, round_about.frames[-1].image)
    assert [f.index for f in round_about.backwards().frames] == [9, 6, 3, 0]
    assert turn.frames[0].image.dtype == np.uint16 and not np.array_equal(roll_homography(WIDE, 10), np.eye(3))


def test_images_of_two_types_become_one() -> None:
    assert {f.image.dtype for f in join([clip("a"), clip("b", dtype=np.uint8)]).frames} == {np.dtype(np.float32)}


def test_the_common_camera_sees_least_and_no_finer_than_any() -> None:
    common = common_camera([WIDE, NARROW])
    assert common.image_size == (32, 24)
    assert common.focal == pytest.approx(WIDE.focal)
    corners = np.array([[-0.5, -0.5], [159.5, 119.5]])
    np.testing.assert_allclose(common.undistort(np.array([[-0.5, -0.5], [31.5, 23.5]])), NARROW.undistort(corners), atol=1e-9)
    assert common_camera([WIDE, WIDE]) is WIDE


def painted(camera: CameraModel) -> np.ndarray:
    """A scene at infinity that is a smooth function of the direction."""
    width, height = camera.image_size
    pixels = np.stack(np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float)), axis=-1).reshape(-1, 2)
    x, y = camera.undistort(pixels).T
    return (3000 + 900 * np.sin(9 * x + 0.3) + 700 * np.cos(7 * y)).reshape(height, width).astype(np.float32)


def test_another_camera_sees_the_same_in_the_same_direction() -> None:
    common = common_camera([WIDE, NARROW])
    for own in (WIDE, NARROW):
        error = np.abs(View(own, common)(painted(own)) - painted(common))
        assert error[1:-1, 1:-1].max() < 40, "of 3200 between dark and bright"
    assert np.abs(cv2.resize(painted(NARROW), common.image_size) - painted(common)).max() < 200
    assert np.abs(cv2.resize(painted(WIDE), common.image_size) - painted(common)).max() > 500, "the scene tells the two apart"


def test_reading_takes_every_nth_and_no_more_than_asked(tmp_path) -> None:
    (tmp_path / "seq").mkdir()
    for i in range(9):
        cv2.imwrite(str(tmp_path / "seq" / f"{i}.png"), np.full((24, 32), 100 + i, np.uint16))
    (tmp_path / "seq" / "camera.yaml").write_text("image_width: 32\nimage_height: 24\ncamera_matrix: {rows: 3, cols: 3, data: [30, 0, 16, 0, 30, 12, 0, 0, 1]}\n")
    read = read_clip(tmp_path / "seq", every=2, max_frames=3)
    assert (read.name, [int(f.image[0, 0]) for f in read.frames], [f.index for f in read.frames]) == ("seq", [100, 102, 104], [0, 2, 4])
    assert read.period_ns == 200_000_000
    assert len(read_clip(tmp_path / "seq").frames) == 9
    with pytest.raises(InputError, match="two are the least"):
        read_clip(tmp_path / "seq", every=9)


def test_the_same_camera_changes_nothing() -> None:
    image = painted(WIDE)
    assert View(WIDE, replace(WIDE, name="again"))(image) is image
