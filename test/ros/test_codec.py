"""Messages to ROS and back: equal in every bit, poses to rounding."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from thegra_core.geometry.camera import CameraModel, DistortionModel
from thegra_core.geometry.poses import so3_exp, transform
from thegra_core.sources.calibration import camera_from_info
from thegra_core.sources.image_decoding import DecodeError
from thegra_ros.codec.clouds import cloud_message, cloud_table
from thegra_ros.codec.images import camera_info_message, frame_from_image, image_message
from thegra_ros.codec.poses import path_message, path_poses, pose_matrix, pose_message, transform_message
from thegra_ros.codec.stamps import header, stamp_ns, time_message

STAMP = 1_700_000_000_123_456_789
HEADER = header(STAMP, "thermal_camera")
numbers = st.floats(-1e6, 1e6)


def over_the_wire(message):
    """As another process receives it."""
    return deserialize_message(serialize_message(message), type(message))


@given(st.integers(0, (2**31 - 1) * 10**9 + 999_999_999))
def test_stamps_are_exact(stamp: int) -> None:
    assert stamp_ns(over_the_wire(time_message(stamp))) == stamp
    assert stamp_ns(header(stamp, "x")) == stamp


@pytest.mark.parametrize("stamp", [-1, 2**31 * 10**9])
def test_stamps_that_no_message_holds_are_refused(stamp: int) -> None:
    with pytest.raises(ValueError, match="no time"):
        time_message(stamp)


@settings(max_examples=30, deadline=None)
@given(st.sampled_from([np.uint8, np.uint16, np.float32]).flatmap(lambda t: arrays.arrays(t, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements={"allow_nan": False, "allow_infinity": False} if t is np.float32 else None)))
def test_images_are_exact(image: np.ndarray) -> None:
    frame = frame_from_image(over_the_wire(image_message(HEADER, image)), 7)
    assert (frame.stamp_ns, frame.index) == (STAMP, 7)
    assert frame.image.dtype == image.dtype and frame.image.tobytes() == image.tobytes()


def test_rows_may_be_padded_and_big_endian() -> None:
    image = np.arange(12, dtype=np.uint16).reshape(3, 4) * 1001
    padded = np.zeros((3, 6), ">u2")
    padded[:, :4] = image
    message = Image(header=HEADER, height=3, width=4, encoding="16UC1", step=12, is_bigendian=1)
    message.data.frombytes(padded.tobytes())
    np.testing.assert_array_equal(frame_from_image(message, 0).image, image)


def test_a_part_of_an_image_is_sent_as_what_it_shows() -> None:
    image = np.arange(100, dtype=np.uint16).reshape(10, 10)[2:8:2, 1:9:3]
    np.testing.assert_array_equal(frame_from_image(image_message(HEADER, image), 0).image, image)


def test_compressed_images_keep_sixteen_bits() -> None:
    import cv2

    image = np.random.default_rng(0).integers(0, 65535, (20, 30), dtype=np.uint16)
    message = CompressedImage(header=HEADER, format="mono16; png compressed")
    message.data.frombytes(cv2.imencode(".png", image)[1].tobytes())
    np.testing.assert_array_equal(frame_from_image(over_the_wire(message), 0).image, image)


def test_what_is_no_image_is_refused() -> None:
    short = image_message(HEADER, np.zeros((4, 4), np.uint8))
    short.height = 5
    with pytest.raises(DecodeError, match="shorter"):
        frame_from_image(short, 0)
    short.encoding = "bayer_rggb8"
    with pytest.raises(DecodeError, match="bayer_rggb8"):
        frame_from_image(short, 0)
    with pytest.raises(ValueError, match="no image"):
        image_message(HEADER, np.zeros((4, 4, 2), np.uint8))


@pytest.mark.parametrize(("model", "count"), [(DistortionModel.PLUMB_BOB, 5), (DistortionModel.RATIONAL_POLYNOMIAL, 8), (DistortionModel.EQUIDISTANT, 4)])
def test_cameras_are_exact(model: DistortionModel, count: int) -> None:
    rng = np.random.default_rng(count)
    camera = CameraModel(np.array([[411.3, 0, 319.7], [0, 410.9, 255.2], [0, 0, 1]]), rng.normal(0, 0.1, count), model, (640, 512), "thermal_camera")
    back = camera_from_info(over_the_wire(camera_info_message(HEADER, camera)))
    assert back is not None and (back.model, back.image_size, back.name) == (model, (640, 512), "thermal_camera")
    assert back.matrix.tobytes() == camera.matrix.tobytes() and back.distortion.tobytes() == camera.distortion.tobytes()


def test_a_camera_that_is_not_calibrated_is_none() -> None:
    assert camera_from_info(CameraInfo(width=640, height=512)) is None


@given(st.tuples(numbers, numbers, numbers), st.tuples(*[st.floats(-3.1, 3.1)] * 3))
def test_poses_are_exact_to_rounding(position, rotation) -> None:
    pose = transform(so3_exp(np.array(rotation)), position)
    back = pose_matrix(over_the_wire(pose_message(pose)))
    np.testing.assert_allclose(back, pose, rtol=0, atol=1e-14 * max(1.0, np.abs(pose).max()))
    stamped = over_the_wire(transform_message(HEADER, "child", pose))
    np.testing.assert_array_equal(pose_matrix(stamped.transform), back)
    assert (stamped.child_frame_id, stamped.header.frame_id) == ("child", "thermal_camera")
    ((stamp, along),) = path_poses(over_the_wire(path_message(HEADER, [(STAMP + 1, pose)])))
    assert stamp == STAMP + 1 and np.array_equal(along, back)


COLUMN_TYPES = [np.int8, np.uint8, np.int16, np.uint16, np.int32, np.uint32, np.float32, np.float64]


@settings(max_examples=40, deadline=None)
@given(st.data(), st.integers(0, 20))
def test_tables_are_exact(data: st.DataObject, rows: int) -> None:
    columns = {}
    for name in data.draw(st.lists(st.sampled_from("abcdef"), min_size=1, unique=True)):
        shape = (rows,) if data.draw(st.booleans()) else (rows, data.draw(st.integers(2, 5)))
        columns[name] = data.draw(arrays.arrays(data.draw(st.sampled_from(COLUMN_TYPES)), shape))
    facts = {"extractor": "aliked", "size": "640x512"}
    table = cloud_table(over_the_wire(cloud_message(HEADER, columns, facts)))
    assert table.facts == facts and list(table.columns) == list(columns)
    for name, column in columns.items():
        assert table.columns[name].dtype == column.dtype and table.columns[name].shape == column.shape
        assert table.columns[name].tobytes() == column.tobytes()


def test_ids_are_exact_or_refused() -> None:
    ids = np.array([-1, 0, 2**53], np.int64)
    np.testing.assert_array_equal(cloud_table(cloud_message(HEADER, {"id": ids})).columns["id"], ids)
    with pytest.raises(ValueError, match="2\\^53"):
        cloud_message(HEADER, {"id": ids + 1})


def test_tables_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="different lengths"):
        cloud_message(HEADER, {"a": np.zeros(3), "b": np.zeros(2)})
    with pytest.raises(ValueError, match="no field"):
        cloud_message(HEADER, {"a": np.zeros(3, complex)})
    cloud = cloud_message(HEADER, {"a": np.zeros(3)})
    cloud.width = 4
    with pytest.raises(ValueError, match="needs 32 bytes and has 24"):
        cloud_table(cloud)


def test_organised_clouds_with_padded_rows_are_read() -> None:
    cloud = cloud_message(HEADER, {"a": np.arange(6, dtype=np.float32)})
    values = np.zeros((2, 4), np.float32)
    values[:, :3] = np.arange(6).reshape(2, 3)
    padded = PointCloud2(header=HEADER, height=2, width=3, fields=cloud.fields, point_step=4, row_step=16)
    padded.data.frombytes(values.tobytes())
    np.testing.assert_array_equal(cloud_table(padded).columns["a"], np.arange(6))
