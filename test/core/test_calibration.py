"""Camera files of every form."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml

from thegra_core.errors import CalibrationError
from thegra_core.geometry.camera import CameraModel, DistortionModel
from thegra_core.sources.calibration import camera_from_info, camera_template, check_image_size, is_rectified, load_camera

MATRIX = [430.0, 0.0, 322.5, 0.0, 431.0, 251.5, 0.0, 0.0, 1.0]
ROS = """\
image_width: 640
image_height: 512
camera_name: tau
distortion_model: {model}
camera_matrix: {{rows: 3, cols: 3, data: [430.0, 0.0, 322.5, 0.0, 431.0, 251.5, 0.0, 0.0, 1.0]}}
distortion_coefficients: {{rows: 1, cols: {count}, data: {data}}}
"""
KALIBR = """\
cam0:
  camera_model: pinhole
  intrinsics: [430.0, 431.0, 322.5, 251.5]
  distortion_model: radtan
  distortion_coeffs: [-0.43, 0.17, -0.001, -0.002]
  resolution: [640, 512]
  rostopic: /thermal/image_raw
cam1:
  camera_model: pinhole
  intrinsics: [531.0, 530.0, 322.0, 239.0]
  distortion_model: equidistant
  distortion_coeffs: [-0.1, 0.01, 0.0, 0.0]
  resolution: [640, 480]
  rostopic: /rgb/image
  T_cn_cnm1: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
"""


def write(tmp_path, text, name="camera.yaml"):
    (tmp_path / name).write_text(text)
    return tmp_path / name


def assert_camera(camera, distortion, model=DistortionModel.PLUMB_BOB, size=(640, 512)):
    np.testing.assert_array_equal(camera.matrix.ravel(), MATRIX)
    np.testing.assert_array_equal(camera.distortion, distortion)
    assert (camera.model, camera.image_size) == (model, size)


@pytest.mark.parametrize(
    ("name", "given", "model", "stored"),
    [
        ("plumb_bob", [-0.3, 0.1, 0.001, 0.002, 0.0], DistortionModel.PLUMB_BOB, [-0.3, 0.1, 0.001, 0.002, 0.0]),
        ("plumb_bob", [], DistortionModel.PLUMB_BOB, [0.0] * 5),
        ("rational_polynomial", [0.1] * 8, DistortionModel.RATIONAL_POLYNOMIAL, [0.1] * 8),
        ("equidistant", [-0.1, 0.2, 0.3, 0.4], DistortionModel.EQUIDISTANT, [-0.1, 0.2, 0.3, 0.4]),
        ("fisheye", [-0.1, 0.2, 0.3, 0.4], DistortionModel.EQUIDISTANT, [-0.1, 0.2, 0.3, 0.4]),
        ("Kannala_Brandt", [-0.1, 0.2, 0.3, 0.4], DistortionModel.EQUIDISTANT, [-0.1, 0.2, 0.3, 0.4]),
    ],
)
def test_ros_yaml(tmp_path, name, given, model, stored):
    camera = load_camera(write(tmp_path, ROS.format(model=name, count=len(given), data=given)))
    assert_camera(camera, stored, model)
    assert camera.name == "tau"


def test_kalibr_picks_by_name_or_topic(tmp_path):
    path = write(tmp_path, KALIBR)
    for picked in ("cam0", "/thermal/image_raw"):
        assert_camera(load_camera(path, picked), [-0.43, 0.17, -0.001, -0.002, 0.0])
    assert load_camera(path, "cam1").model is DistortionModel.EQUIDISTANT
    with pytest.raises(CalibrationError, match=r"several cameras(.|\n)*cam0  /thermal/image_raw(.|\n)*cam1  /rgb/image(.|\n)*--camera"):
        load_camera(path)
    with pytest.raises(CalibrationError, match="no camera 'cam7'"):
        load_camera(path, "cam7")


def test_kalibr_with_one_camera_and_another_model(tmp_path):
    one = KALIBR.split("cam1:")[0]
    assert_camera(load_camera(write(tmp_path, one)), [-0.43, 0.17, -0.001, -0.002, 0.0])
    with pytest.raises(CalibrationError, match="'omni' is not supported"):
        load_camera(write(tmp_path, one.replace("pinhole", "omni")))


def test_opencv_file_storage(tmp_path):
    path = tmp_path / "opencv.yaml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 512)
    storage.write("camera_matrix", np.array(MATRIX).reshape(3, 3))
    storage.write("distortion_coefficients", np.array([[-0.3, 0.1, 0.0, 0.0, 0.01]]))
    storage.release()
    assert "opencv-matrix" in path.read_text()
    assert_camera(load_camera(path), [-0.3, 0.1, 0.0, 0.0, 0.01])


def test_dotted_opencv_settings_with_old_header(tmp_path):
    text = "%YAML:1.0\nCamera.fx: 430.0\nCamera.fy: 431.0\nCamera.cx: 322.5\nCamera.cy: 251.5\nCamera.k1: -0.3\nCamera.k2: 0.1\nCamera.p1: 0.0\nCamera.p2: 0.0\nCamera.width: 640\nCamera.height: 512\n"
    assert_camera(load_camera(write(tmp_path, text)), [-0.3, 0.1, 0.0, 0.0, 0.0])


def test_echoed_camera_info(tmp_path):
    text = f"header: {{frame_id: cam}}\nheight: 512\nwidth: 640\ndistortion_model: plumb_bob\nd: [-0.3, 0.1, 0.0, 0.0, 0.0]\nk: {MATRIX}\n---\nheight: 512\n---\n"
    assert_camera(load_camera(write(tmp_path, text)), [-0.3, 0.1, 0.0, 0.0, 0.0])


def test_plain_numbers(tmp_path):
    assert_camera(load_camera(write(tmp_path, "430,431,322.5,251.5\n"), image_size=(640, 512)), [0.0] * 5)
    assert_camera(load_camera(write(tmp_path, "# fx fy cx cy w h\n430 431 322.5 251.5 640 512")), [0.0] * 5)
    assert_camera(load_camera(write(tmp_path, "430 431 322.5 251.5\n640 512\n-0.3 0.1 0.001 0.002 0.01\n")), [-0.3, 0.1, 0.001, 0.002, 0.01])
    with pytest.raises(CalibrationError, match="does not say the image size"):
        load_camera(write(tmp_path, "430,431,322.5,251.5"))
    with pytest.raises(CalibrationError, match="holds 3 numbers"):
        load_camera(write(tmp_path, "430 431 322"))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "holds no camera"),
        ("a: [", "is not YAML"),
        ("- 1\n- 2\n", "holds no camera"),
        ("hello: world", "no camera matrix; understood are: ROS camera_info"),
        (ROS.format(model="ds", count=0, data=[]), "unknown distortion model 'ds'; known: "),
        (ROS.format(model="plumb_bob", count=0, data=[]).replace("430.0", "-1"), "must be positive"),
        ("camera_matrix: {data: [0, 0, 0, 0, 0, 0, 0, 0, 0]}\nimage_width: 2\nimage_height: 2", "all zero"),
        ("camera_matrix: {data: [1, 2]}\n", "9 numbers"),
        ("camera_matrix: {data: [9, 0, 1, 0, 9, 1, 0, 0, 1]}\n", "does not say the image size"),
    ],
)
def test_unusable_files(tmp_path, text, reason):
    with pytest.raises(CalibrationError, match=reason):
        load_camera(write(tmp_path, text))


def test_missing_file(tmp_path):
    with pytest.raises(CalibrationError, match="No such file"):
        load_camera(tmp_path / "none.yaml")


def test_template_must_be_filled_in_and_then_loads(tmp_path):
    text = camera_template(640, 512)
    with pytest.raises(CalibrationError, match="fill in the capitals"):
        load_camera(write(tmp_path, text))
    for name, value in zip(["FX", "CX", "FY", "CY", "K1", "K2", "P1", "P2", "K3"], [430.0, 322.5, 431.0, 251.5, -0.3, 0.1, 0, 0, 0], strict=True):
        text = text.replace(name, str(value))
    assert_camera(load_camera(write(tmp_path, text)), [-0.3, 0.1, 0, 0, 0])
    assert yaml.safe_load(text)["image_width"] == 640


def info(names=("k", "d"), k=MATRIX, d=(-0.3, 0.1, 0.0, 0.0, 0.0), model="plumb_bob"):
    fields = {names[0]: np.array(k), names[1]: np.array(d)}
    return SimpleNamespace(**fields, distortion_model=model, width=640, height=512, header=SimpleNamespace(frame_id="cam"))


def test_camera_info_of_ros_1_and_2():
    for names in (("k", "d"), ("K", "D")):
        assert_camera(camera_from_info(info(names)), [-0.3, 0.1, 0.0, 0.0, 0.0])
    assert camera_from_info(info(k=[0.0] * 9)) is None
    with pytest.raises(CalibrationError, match="unknown distortion model"):
        camera_from_info(info(model="magic"))


def test_image_size_is_checked():
    camera = CameraModel(np.array(MATRIX).reshape(3, 3), np.zeros(5), DistortionModel.PLUMB_BOB, (640, 512))
    check_image_size(camera, (512, 640))
    with pytest.raises(CalibrationError, match="320x256 but the camera file is for 640x512"):
        check_image_size(camera, (256, 320))


def test_a_fisheye_of_orb_slam_has_four_coefficients(tmp_path):
    numbers = "Camera1.fx: 430.0\nCamera1.fy: 431.0\nCamera1.cx: 322.5\nCamera1.cy: 251.5\nCamera1.k1: 0.01\nCamera1.k2: 0.02\nCamera1.k3: 0.03\nCamera1.k4: 0.04\n"
    camera = load_camera(write(tmp_path, f'%YAML:1.0\nCamera.type: "KannalaBrandt8"\n{numbers}Camera.width: 640\nCamera.height: 512\n'))
    assert camera.model is DistortionModel.EQUIDISTANT
    np.testing.assert_array_equal(camera.distortion, [0.01, 0.02, 0.03, 0.04])


@pytest.mark.parametrize(("topic", "rectified"), [
    ("/cam/image_rect", True), ("/cam/image_rect_color", True), ("/cam/image_rect/compressed", True), ("/cam/image_raw", False), ("/image_rect/raw", False),
])  # fmt: skip
def test_topics_of_rectified_images(topic, rectified):
    assert is_rectified(topic) is rectified
