"""Bags of every kind, sound and damaged."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest
from bag_making import (
    COMPRESSED,
    IMAGE,
    INFO,
    RECEIVED_LATER,
    ROS1,
    ROS2,
    T0,
    compressed_message,
    image_message,
    info_message,
    infos,
    picture,
    stream,
    write_ros1,
    write_ros2,
)
from mcap.writer import Writer

from thegra_core.errors import CalibrationError, InputError
from thegra_core.sources.open import camera_for, image_topics, open_recording


def assert_whole(recording, count=6):
    frames = list(recording.frames())
    assert [f.stamp_ns for f in frames] == [T0 + i * 10**8 for i in range(count)], "header stamps, not receive times"
    assert [f.index for f in frames] == list(range(count))
    for frame in frames:
        assert frame.image.dtype == np.uint16
        np.testing.assert_array_equal(frame.image, picture(frame.index))


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
def test_ros1_bag(tmp_path, compression):
    recording = open_recording(write_ros1(tmp_path / "a.bag", stream(ROS1) + infos(ROS1), compression))
    assert_whole(recording)
    assert_whole(recording)  # a recording can be read again
    assert (recording.name, recording.topic, recording.frame_count, dict(recording.problems)) == ("a", "/thermal/image_raw", 6, {})
    assert recording.camera is not None
    assert recording.camera.image_size == (32, 24)
    np.testing.assert_allclose(recording.camera.distortion, [-0.4, 0.1, 0, 0, 0])


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("compression", [None, "FILE", "MESSAGE"])
def test_rosbag2_folder(tmp_path, storage, compression):
    recording = open_recording(write_ros2(tmp_path / "run", stream(ROS2) + infos(ROS2), storage, compression))
    assert_whole(recording)
    assert recording.name == "run"
    assert recording.camera is not None
    assert camera_for(recording) is recording.camera


@pytest.mark.parametrize(("storage", "suffix", "compression"), [("MCAP", ".mcap", None), ("MCAP", ".mcap", "STORAGE"), ("SQLITE3", ".db3", None), ("SQLITE3", ".db3", "MESSAGE")])
@pytest.mark.parametrize("keep_folder", [True, False])
def test_storage_file_alone_and_folder_without_metadata(tmp_path, storage, suffix, compression, keep_folder):
    folder = write_ros2(tmp_path / "run", stream(ROS2) + infos(ROS2), storage, compression)
    (folder / "metadata.yaml").unlink()
    recording = open_recording(folder if keep_folder else next(folder.glob("*" + suffix)))
    assert_whole(recording)
    assert any("metadata.yaml missing" in problem for problem in recording.problems) == keep_folder


def test_split_ros1_bags_follow_each_other_in_natural_order(tmp_path):
    items = stream(ROS1, 6)
    for number, part in ((2, items[:2]), (10, items[2:4]), (11, items[4:])):
        write_ros1(tmp_path / f"flight_{number}.bag", part)
    recording = open_recording(tmp_path)
    assert_whole(recording)
    assert recording.frame_count == 6


def test_compressed_images_16_bit_png_and_jpeg(tmp_path):
    png = stream(ROS2, make=compressed_message, topic="/thermal/image_raw/compressed", kind=COMPRESSED)
    assert_whole(open_recording(write_ros2(tmp_path / "png", png)))
    gray = np.tile(np.arange(0, 256, 8, dtype=np.uint8), (24, 1))
    jpeg = [("/cam/compressed", COMPRESSED, compressed_message(ROS1, gray, T0, ".jpg", "jpeg"), T0)]
    (frame,) = open_recording(write_ros1(tmp_path / "jpeg.bag", jpeg)).frames()
    assert frame.image.dtype == np.uint8
    assert np.abs(frame.image.astype(int) - gray).max() < 12


def cut(path: Path, target: Path, keep: float) -> Path:
    data = path.read_bytes()
    target.write_bytes(data[: int(len(data) * keep)])
    return target


def assert_start_of_stream(recording):
    frames = list(recording.frames())
    assert 0 < len(frames) < 40
    for frame in frames:
        assert frame.stamp_ns == T0 + frame.index * 10**8
        np.testing.assert_array_equal(frame.image, picture(frame.index))
    assert any("without its index" in problem for problem in recording.problems)
    assert any("breaks off" in problem for problem in recording.problems)


@pytest.mark.parametrize("compression", [None, "LZ4"])
def test_truncated_ros1_bag_gives_what_is_there(tmp_path, compression):
    whole = write_ros1(tmp_path / "whole.bag", stream(ROS1, 40), compression)
    assert_start_of_stream(open_recording(cut(whole, tmp_path / "cut.bag", 0.6)))


def test_unindexed_ros1_bag_is_read_whole(tmp_path):
    path = write_ros1(tmp_path / "active.bag", stream(ROS1) + infos(ROS1))
    data = path.read_bytes()
    start = data.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(data[:start] + bytes(8) + data[start + 8 :])
    recording = open_recording(path)
    assert_whole(recording)
    assert recording.camera is not None
    assert any("not indexed" in problem for problem in recording.problems)


def test_truncated_db3_gives_what_is_there(tmp_path):
    folder = write_ros2(tmp_path / "run", stream(ROS2, 40))
    assert_start_of_stream(open_recording(cut(next(folder.glob("*.db3")), tmp_path / "cut.db3", 0.6)))


def write_mcap(path, store, encoding, count=40, chunk_bytes=4000, profile=""):
    """An mcap as tools other than rosbag2 write them."""
    serialise = store.serialize_cdr if encoding == "cdr" else store.serialize_ros1
    kind = IMAGE if encoding == "cdr" else "sensor_msgs/Image"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_bytes)
        writer.start(profile=profile)
        schema = writer.register_schema(kind, "ros2msg" if encoding == "cdr" else "ros1msg", b"")
        channel = writer.register_channel("/thermal/image_raw", encoding, schema)
        for i in range(count):
            stamp = T0 + i * 10**8
            data = bytes(serialise(image_message(store, picture(i), stamp), IMAGE))
            writer.add_message(channel, stamp + 77, data, stamp + 77)
        writer.finish()
    return path


@pytest.mark.parametrize(("store", "encoding"), [(ROS2, "cdr"), (ROS1, "ros1")])
def test_mcap_written_by_other_tools(tmp_path, store, encoding):
    assert_whole(open_recording(write_mcap(tmp_path / "a.mcap", store, encoding)), 40)


def test_messages_of_another_encoding_do_not_end_an_mcap(tmp_path):
    path = tmp_path / "mixed.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        images = writer.register_channel("/thermal/image_raw", "cdr", writer.register_schema(IMAGE, "ros2msg", b""))
        log = writer.register_channel("/log", "json", writer.register_schema("foxglove.Log", "jsonschema", b"{}"))
        writer.add_message(log, T0, b"{}", T0)
        for i in range(12):
            stamp = T0 + i * 10**8
            writer.add_message(images, stamp, bytes(ROS2.serialize_cdr(image_message(ROS2, picture(i), stamp), IMAGE)), stamp)
            writer.add_message(log, stamp, b"{}", stamp)
        writer.finish()
    recording = open_recording(path)
    assert (recording.frame_count, len(list(recording.frames()))) == (12, 12)
    assert not any("breaks off" in problem for problem in recording.problems)


@pytest.mark.parametrize("topic", ["/thermal/image_rect", "/thermal/image_rect/compressed"])
@pytest.mark.parametrize("store", [ROS1, ROS2])
def test_rectified_images_have_the_projection_and_no_distortion(tmp_path, store, topic):
    info = info_message(store, T0)
    setattr(info, "P" if store is ROS1 else "p", np.array([80.0, 0, 15, 0, 0, 81, 11, 0, 0, 0, 1, 0]))
    images = stream(store, 3, topic, compressed_message, COMPRESSED) if topic.endswith("compressed") else stream(store, 3, topic)
    items = [*images, ("/thermal/camera_info", INFO, info, T0)]
    recording = open_recording(write_ros1(tmp_path / "a.bag", items) if store is ROS1 else write_ros2(tmp_path / "a", items))
    assert recording.camera is not None and not recording.camera.distortion.any()
    np.testing.assert_array_equal(recording.camera.matrix, [[80, 0, 15], [0, 81, 11], [0, 0, 1]])
    assert "camera from /thermal/camera_info, of rectified images" in recording.notes


def test_rectified_images_without_a_projection_have_no_camera(tmp_path):
    recording = open_recording(write_ros1(tmp_path / "a.bag", [*stream(ROS1, 3, "/thermal/image_rect"), *infos(ROS1)]))
    assert recording.camera is None
    assert any("says P = 0" in note for note in recording.notes)


@pytest.mark.parametrize("in_folder", [True, False])
def test_truncated_mcap_gives_what_is_there(tmp_path, in_folder):
    whole = write_mcap(tmp_path / "a.mcap", ROS2, "cdr", profile="ros2")
    folder = write_ros2(tmp_path / "run", stream(ROS2, 6), "MCAP")
    target = cut(whole, next(folder.glob("*.mcap")), 0.6)
    assert_start_of_stream(open_recording(folder if in_folder else target))


def test_mcap_without_closing_records_is_read_whole(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", ROS2, "cdr", profile="ros2")
    path.write_bytes(path.read_bytes()[:-40])
    assert_whole(open_recording(path), 40)


@pytest.mark.parametrize("name", ["empty.bag", "empty.mcap", "empty.db3"])
def test_empty_file(tmp_path, name):
    (tmp_path / name).touch()
    with pytest.raises(InputError, match=r"is empty; give a ROS 1 \.bag"):
        open_recording(tmp_path / name)


def test_bag_cut_before_its_first_image(tmp_path):
    whole = write_ros1(tmp_path / "whole.bag", stream(ROS1))
    with pytest.raises(InputError, match=r"no image can be read(.|\n)*reindex"):
        open_recording(cut(whole, tmp_path / "cut.bag", 0.05))


def test_bag_without_messages(tmp_path):
    with pytest.raises(InputError, match="no image topic"):
        open_recording(write_ros2(tmp_path / "none", infos(ROS2)))


def test_wrong_topic_lists_what_there_is(tmp_path):
    path = write_ros1(tmp_path / "a.bag", stream(ROS1))
    with pytest.raises(InputError) as error:
        open_recording(path, "/camera/image")
    assert "/thermal/image_raw  Image, 6 messages 32x24 mono16" in str(error.value)
    assert f"thegra run {path} --topic /thermal/image_raw" in str(error.value)


FLAGS = {"Bool": (False, True), "UInt8": (0, 2)}


def flag_items(store, kind, changes):
    """The camera's word on its shutter: {time (ns after the first image): closed}."""
    full = f"std_msgs/msg/{kind}"
    return [("/boson/ffc", full, store.types[full](data=FLAGS[kind][closed]), T0 + RECEIVED_LATER + after) for after, closed in changes.items()]


@pytest.mark.parametrize("kind", FLAGS)
@pytest.mark.parametrize("ros", [1, 2])
def test_shutter_topic(tmp_path, kind, ros):
    store, write = (ROS1, write_ros1) if ros == 1 else (ROS2, write_ros2)
    items = sorted([*stream(store, 8), *flag_items(store, kind, {150_000_000: False, 250_000_000: True, 550_000_000: False})], key=lambda item: item[3])
    recording = open_recording(write(tmp_path / "a.bag", items), shutter_topic="boson/ffc")
    assert [f.shutter_closed for f in recording.frames()] == [None, None, False, True, True, True, False, False]
    assert [f.index for f in recording.frames()] == list(range(8))
    assert {f.shutter_closed for f in open_recording(recording.path).frames()} == {None}


def test_wrong_shutter_topic_lists_what_there_is(tmp_path):
    path = write_ros2(tmp_path / "a", [*stream(ROS2), *flag_items(ROS2, "Bool", {0: False})])
    with pytest.raises(InputError, match=r"(?s)has no topic '/ffc'.*such topics are:\n  /boson/ffc  std_msgs/msg/Bool"):
        open_recording(path, shutter_topic="/ffc")
    with pytest.raises(InputError, match="such topics are: none"):
        open_recording(write_ros2(tmp_path / "b", stream(ROS2)), shutter_topic="/ffc")
    (tmp_path / "images").mkdir()
    with pytest.raises(InputError, match=r"--shutter-topic /ffc is given but .* is no bag"):
        open_recording(tmp_path / "images", shutter_topic="/ffc")


def test_topic_without_slash_and_without_compressed(tmp_path):
    items = stream(ROS2, make=compressed_message, topic="/a/image/compressed", kind=COMPRESSED)
    assert open_recording(write_ros2(tmp_path / "a", items), "a/image").topic == "/a/image/compressed"


def gray_stream(topic):
    return [(topic, IMAGE, image_message(ROS2, picture(i).astype(np.uint8), T0 + i, "mono8"), T0 + i) for i in range(3)]


def test_topic_is_guessed_only_when_one_fits(tmp_path):
    thermal_by_name = gray_stream("/rgb/image") + gray_stream("/thermal/image_raw") + gray_stream("/depth/image_raw")
    assert open_recording(write_ros2(tmp_path / "name", thermal_by_name)).topic == "/thermal/image_raw"
    thermal_by_depth = gray_stream("/left/image") + stream(ROS2, topic="/right/image") + stream(ROS2, topic="/depth/image")
    assert open_recording(write_ros2(tmp_path / "bits", thermal_by_depth)).topic == "/right/image"
    twin = stream(ROS2, topic="/a/image") + stream(ROS2, make=compressed_message, topic="/a/image/compressed", kind=COMPRESSED)
    assert open_recording(write_ros2(tmp_path / "twin", twin)).topic == "/a/image"
    with pytest.raises(InputError, match=r"several image topics(.|\n)*/left/image(.|\n)*/right/image(.|\n)*--topic"):
        open_recording(write_ros2(tmp_path / "two", gray_stream("/left/image") + gray_stream("/right/image")))


def test_image_topics(tmp_path):
    topics = image_topics(write_ros2(tmp_path / "a", stream(ROS2) + gray_stream("/rgb/image")))
    assert [(t.name, t.count, t.encoding, t.size) for t in topics] == [("/rgb/image", 3, "mono8", (32, 24)), ("/thermal/image_raw", 6, "mono16", (32, 24))]


def test_camera_info_of_another_camera_is_not_used(tmp_path):
    items = stream(ROS2) + gray_stream("/rgb/image") + infos(ROS2, "/rgb/camera_info")
    assert open_recording(write_ros2(tmp_path / "a", items)).camera is None


def test_zero_k_means_no_camera(tmp_path):
    recording = open_recording(write_ros1(tmp_path / "a.bag", stream(ROS1) + infos(ROS1, k=[0.0] * 9)))
    assert recording.camera is None
    assert any("K = 0" in note for note in recording.notes)
    with pytest.raises(CalibrationError, match=r"image_width: 32(.|\n)*\[FX, 0.0, CX"):
        camera_for(recording)


def test_camera_file_beside_a_bag_without_camera_info(tmp_path):
    (tmp_path / "camera.yaml").write_text("image_width: 32\nimage_height: 24\ncamera_matrix: {data: [9, 0, 1, 0, 9, 1, 0, 0, 1]}\n")
    recording = open_recording(write_ros1(tmp_path / "a.bag", stream(ROS1)))
    assert recording.camera is not None
    assert recording.camera.matrix[0, 0] == 9


def test_bad_messages_are_counted_and_skipped(tmp_path):
    good = stream(ROS2, 2)
    floats = np.full((24, 32), np.nan, np.float32)
    bad = [
        image_message(ROS2, picture(2), T0 + 2, "bayer_rggb8"),
        image_message(ROS2, picture(3), T0 + 3, data=np.zeros(10, np.uint8)),
        image_message(ROS2, picture(4), T0 + 4, width=0),
        image_message(ROS2, floats, T0 + 5, "32FC1"),
    ]
    items = good + [("/thermal/image_raw", IMAGE, message, T0 + 10**9 + i) for i, message in enumerate(bad)]
    recording = open_recording(write_ros2(tmp_path / "a", items))
    assert [f.index for f in recording.frames()] == [0, 1]
    assert sum(recording.problems.values()) == 4
    assert {"unknown encoding 'bayer_rggb8'", "image of zero size", "image data shorter than its header says"} <= recording.problems.keys()


def test_duplicate_and_backward_stamps_are_handed_on(tmp_path):
    stamps = [T0, T0 + 10, T0 + 10, T0 + 5]
    items = [("/t/image", IMAGE, image_message(ROS1, picture(i), stamp), T0 + i) for i, stamp in enumerate(stamps)]
    assert [f.stamp_ns for f in open_recording(write_ros1(tmp_path / "a.bag", items)).frames()] == stamps


def test_stamps_that_were_never_filled_in_are_said(tmp_path):
    items = [("/t/image", IMAGE, image_message(ROS1, picture(i), 0), T0 + i) for i in range(2)]
    recording = open_recording(write_ros1(tmp_path / "a.bag", items))
    assert [f.stamp_ns for f in recording.frames()] == [0, 0]
    assert any("header stamps are 0" in note for note in recording.notes)


def test_log_left_by_a_crashed_recorder_is_said(tmp_path):
    folder = write_ros2(tmp_path / "run", stream(ROS2))
    file = next(folder.glob("*.db3"))
    file.with_name(file.name + "-wal").write_bytes(b"x")
    recording = open_recording(file)
    assert len(list(recording.frames())) == 6
    assert any("wal_checkpoint" in problem for problem in recording.problems)


def test_compressed_bag_without_metadata(tmp_path):
    folder = write_ros2(tmp_path / "run", stream(ROS2), "MCAP", "FILE")
    (folder / "metadata.yaml").unlink()
    with pytest.raises(InputError, match="zstd -d"):
        open_recording(folder)


@pytest.mark.parametrize("kind", ["bag", "mcap", "db3"])
def test_random_damage_never_crashes(tmp_path, kind):
    rng = np.random.default_rng(7)
    if kind == "bag":
        whole = write_ros1(tmp_path / "whole.bag", stream(ROS1) + infos(ROS1), "LZ4").read_bytes()
    else:
        folder = write_ros2(tmp_path / "run", stream(ROS2) + infos(ROS2), {"mcap": "MCAP", "db3": "SQLITE3"}[kind])
        whole = next(folder.glob("*." + kind)).read_bytes()
    opened = 0
    for i in range(25):
        data = np.frombuffer(whole, np.uint8).copy()
        data[rng.integers(0, len(data) if i % 2 else 1500, 6)] = rng.integers(0, 256, 6)
        path = tmp_path / f"damaged.{kind}"
        path.write_bytes(data.tobytes())
        with contextlib.suppress(InputError):
            opened += len(list(open_recording(path).frames())) > 0
    assert opened > 0


def test_not_a_recording(tmp_path):
    (tmp_path / "x.doc").write_text("hello")
    with pytest.raises(InputError, match="no recording; give"):
        open_recording(tmp_path / "x.doc")
    with pytest.raises(InputError, match="does not exist"):
        open_recording(tmp_path / "y.bag")
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 5}")
    with pytest.raises(InputError, match="no bag that can be read"):
        open_recording(tmp_path / "r")
