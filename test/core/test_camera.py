"""Camera models against OpenCV's, which defines them, and against themselves."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thegra_core.errors import CalibrationError
from thegra_core.geometry.camera import CameraModel, DistortionModel

SIZE = (640, 512)
PLUMB_BOB = CameraModel(
    np.array([[575.0, 0, 327.3], [0, 573.0, 248.9], [0, 0, 1]]), np.array([-0.43, 0.19, 1.1e-3, -7e-4, -0.03]), DistortionModel.PLUMB_BOB, SIZE
)
RATIONAL = CameraModel(
    np.array([[520.0, 0, 315.0], [0, 522.0, 260.0], [0, 0, 1]]),
    np.array([0.9, 0.35, 4e-4, -6e-4, 0.02, 1.25, 0.55, 0.08]),
    DistortionModel.RATIONAL_POLYNOMIAL,
    SIZE,
)
# 91 degrees across the image: the equidistant radius of its left and right edge is 45.5 degrees times the focal length
EQUIDISTANT = CameraModel(
    np.array([[402.0, 0, 321.5], [0, 401.0, 254.0], [0, 0, 1]]), np.array([-0.012, 0.004, -0.006, 0.0015]), DistortionModel.EQUIDISTANT, SIZE
)
PLAIN_FISHEYE = CameraModel(np.array([[402.0, 0, 321.5], [0, 401.0, 254.0], [0, 0, 1]]), np.zeros(4), DistortionModel.EQUIDISTANT, SIZE)
PINHOLE = CameraModel(np.array([[500.0, 0, 320], [0, 500, 256], [0, 0, 1]]), np.zeros(5), DistortionModel.PLUMB_BOB, SIZE)
CAMERAS = {"plumb_bob": PLUMB_BOB, "rational_polynomial": RATIONAL, "equidistant": EQUIDISTANT, "equidistant without coefficients": PLAIN_FISHEYE, "pinhole": PINHOLE}
CORNERS = np.array([[0.0, 0.0], [639.0, 0.0], [0.0, 511.0], [639.0, 511.0]])

camera_of_each_model = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())


def opencv_project(camera: CameraModel, points: np.ndarray) -> np.ndarray:
    if camera.model is DistortionModel.EQUIDISTANT:
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    else:
        pixels, _ = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    return pixels[:, 0]


@camera_of_each_model
def test_projection_is_opencvs(camera: CameraModel) -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-0.6, 0.6, (200, 2)), np.ones((200, 1))], axis=1) * rng.uniform(0.2, 30, (200, 1))
    np.testing.assert_allclose(camera.project(points), opencv_project(camera, points), atol=1e-9)


def test_projection_by_hand() -> None:
    # x = 0.5, r^2 = 0.25, radial = 1 - 0.4 * 0.25 = 0.9: u = 500 * 0.45 + 320
    camera = CameraModel(PINHOLE.matrix, np.array([-0.4]), DistortionModel.PLUMB_BOB, SIZE)
    np.testing.assert_allclose(camera.project(np.array([[1.0, 0.0, 2.0]])), [[545.0, 256.0]])
    np.testing.assert_allclose(PINHOLE.project(np.array([[0.0, 0.0, 7.0]])), [[320.0, 256.0]])


@camera_of_each_model
def test_corners_survive_a_round_trip(camera: CameraModel) -> None:
    np.testing.assert_allclose(camera.distort(camera.undistort(CORNERS)), CORNERS, atol=1e-9)


@camera_of_each_model
def test_every_pixel_has_one_ray_and_rays_spread_outwards(camera: CameraModel) -> None:
    """A grid of pixels comes back, and along each row the undistorted x grows: no pixel is given the outer root of a folding polynomial."""
    u, v = np.meshgrid(np.linspace(0, 639, 41), np.linspace(0, 511, 33))
    normalized = camera.undistort(np.stack([u.ravel(), v.ravel()], axis=1))
    assert np.isfinite(normalized).all()
    np.testing.assert_allclose(camera.distort(normalized), np.stack([u.ravel(), v.ravel()], axis=1), atol=1e-9)
    assert (np.diff(normalized[:, 0].reshape(u.shape), axis=1) > 0).all()
    assert (np.diff(normalized[:, 1].reshape(u.shape), axis=0) > 0).all()


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(sorted(CAMERAS)), st.floats(0, 639), st.floats(0, 511), st.floats(0.1, 100))
def test_any_pixel_survives_a_round_trip(name: str, u: float, v: float, depth: float) -> None:
    camera = CAMERAS[name]
    pixel = np.array([[u, v]])
    ray = camera.bearings(pixel)
    assert np.linalg.norm(ray) == pytest.approx(1.0)
    np.testing.assert_allclose(camera.project(depth * ray), pixel, atol=1e-8)


def test_field_of_view_of_the_fisheye() -> None:
    ends = EQUIDISTANT.bearings(np.array([[0.0, 254.0], [639.0, 254.0]]))
    assert np.degrees(np.arccos(ends[0] @ ends[1])) == pytest.approx(91.0, abs=1.0)


@camera_of_each_model
def test_points_behind_the_camera_have_no_pixel(camera: CameraModel) -> None:
    pixels = camera.project(np.array([[0.1, 0.1, -1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    assert np.isnan(pixels[:3]).all()
    assert np.isfinite(pixels[3]).all()


def test_pixels_beyond_the_radius_where_the_model_turns_back_have_no_ray() -> None:
    # r (1 - 0.43 r^2) is at most 0.587, at r = 0.880
    camera = CameraModel(PINHOLE.matrix, np.array([-0.43]), DistortionModel.PLUMB_BOB, SIZE)
    reachable = camera.undistort(np.array([[320 + 500 * 0.58, 256.0]]))
    assert 0.7 < reachable[0, 0] < 0.8804
    assert np.isnan(camera.undistort(np.array([[320 + 500 * 0.60, 256.0]]))).all()
    wide = CameraModel(np.array([[200.0, 0, 320], [0, 200, 256], [0, 0, 1]]), np.zeros(4), DistortionModel.EQUIDISTANT, SIZE)
    assert np.isfinite(wide.undistort(np.array([[320 + 200 * 1.5, 256.0]]))).all()
    assert np.isnan(wide.undistort(np.array([[320 + 200 * 1.6, 256.0]]))).all()  # beyond 90 degrees


def test_rejected_pixels_do_not_disturb_the_others() -> None:
    camera = CameraModel(PINHOLE.matrix, np.array([-0.43]), DistortionModel.PLUMB_BOB, SIZE)
    inside = np.array([[400.0, 300.0], [10.0, 200.0]])
    mixed = camera.undistort(np.concatenate([inside, [[2000.0, 2000.0]]]))
    np.testing.assert_array_equal(np.isnan(mixed).any(axis=1), [False, True, True])
    np.testing.assert_allclose(mixed[:1], camera.undistort(inside[:1]), atol=1e-12)


@pytest.mark.parametrize("focal", [0.0, -500.0, np.nan, np.inf])
def test_a_matrix_without_focal_length_is_refused(focal: float) -> None:
    with pytest.raises(CalibrationError, match="--camera"):
        CameraModel(np.diag([focal, 500.0, 1.0]), np.zeros(5), DistortionModel.PLUMB_BOB, SIZE)
    with pytest.raises(CalibrationError, match="--camera"):
        CameraModel(np.zeros((3, 3)), np.zeros(5), DistortionModel.PLUMB_BOB, SIZE)


def test_coefficients_that_are_no_numbers_are_refused() -> None:
    with pytest.raises(CalibrationError, match="distortion"):
        CameraModel(PINHOLE.matrix, np.array([np.nan, 0.0]), DistortionModel.PLUMB_BOB, SIZE)


@pytest.mark.parametrize(("model", "most"), [(DistortionModel.PLUMB_BOB, 5), (DistortionModel.RATIONAL_POLYNOMIAL, 8), (DistortionModel.EQUIDISTANT, 4)])
def test_too_many_coefficients_are_refused(model: DistortionModel, most: int) -> None:
    with pytest.raises(CalibrationError, match=f"at most {most}"):
        CameraModel(PINHOLE.matrix, np.full(most + 1, 0.01), model, SIZE)
    padded = CameraModel(PINHOLE.matrix, np.array([0.01] * most + [0.0] * 3), model, SIZE)
    np.testing.assert_array_equal(padded.distortion, np.full(most, 0.01))
    assert len(CameraModel(PINHOLE.matrix, np.array([]), model, SIZE).distortion) == most


def test_largest_radius_is_the_farthest_corners() -> None:
    assert PINHOLE.max_radius == pytest.approx(np.hypot(320, 256) / 500)
    assert PLUMB_BOB.max_radius == pytest.approx(np.linalg.norm(PLUMB_BOB.undistort(CORNERS), axis=1).max())


def test_image_bounds_are_the_outer_pixels_centres() -> None:
    pixels = np.array([[0.0, 0.0], [639.0, 511.0], [639.001, 0.0], [0.0, -0.001], [np.nan, 5.0]])
    np.testing.assert_array_equal(PINHOLE.contains(pixels), [True, True, False, False, False])
    np.testing.assert_array_equal(PINHOLE.contains(np.array([[4.0, 4.0], [3.9, 100.0]]), border=4), [True, False])


def test_focal_length_is_the_geometric_mean() -> None:
    assert CameraModel(np.diag([400.0, 900.0, 1.0]), np.zeros(5), DistortionModel.PLUMB_BOB, SIZE).focal == pytest.approx(600.0)


@camera_of_each_model
def test_no_pixels_are_fine(camera: CameraModel) -> None:
    assert camera.undistort(np.empty((0, 2))).shape == (0, 2)
    assert camera.project(np.empty((0, 3))).shape == (0, 2)
    assert camera.bearings(np.empty((0, 2))).shape == (0, 3)
