"""Image folders and videos."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from thegra_core.errors import CalibrationError, InputError
from thegra_core.messages import Frame
from thegra_core.sources.folder import natural_key, parse_stamp
from thegra_core.sources.open import camera_for, image_topics, open_recording

CAMERA = "image_width: 32\nimage_height: 24\ncamera_matrix: {rows: 3, cols: 3, data: [30, 0, 16, 0, 30, 12, 0, 0, 1]}\n"


def write_images(folder, names, dtype=np.uint16):
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / name), np.full((24, 32), 100 + i, dtype))


@pytest.mark.parametrize("name", ["images.txt", "rgb.txt"])
def test_listed_folder(tmp_path, name):
    write_images(tmp_path / "images", ["b.png", "a.png"])
    (tmp_path / name).write_text("# stamp file\n1700000000.123456789 images/b.png\n1700000000.5 images/a.png\n")
    (tmp_path / "camera.yaml").write_text(CAMERA)
    (tmp_path / "groundtruth.txt").write_text("")
    recording = open_recording(tmp_path)
    frames = list(recording.frames())
    assert [f.stamp_ns for f in frames] == [1700000000123456789, 1700000000500000000]
    assert [int(f.image[0, 0]) for f in frames] == [100, 101]
    assert frames[0].image.dtype == np.uint16
    assert (recording.frame_count, recording.topic, recording.groundtruth) == (2, None, tmp_path / "groundtruth.txt")
    assert recording.camera is not None
    assert image_topics(tmp_path) == []
    assert len(list(open_recording(tmp_path / name).frames())) == 2


def test_plain_folder_is_in_natural_order_with_stated_stamps(tmp_path):
    write_images(tmp_path / "seq" / "images", ["im2.png", "im10.png", "im1.png"])
    (tmp_path / "seq" / "camera.yaml").write_text(CAMERA)
    recording = open_recording(tmp_path / "seq" / "images")
    assert [int(f.image[0, 0]) for f in recording.frames()] == [102, 100, 101]
    assert [f.stamp_ns for f in recording.frames()] == [0, 10**8, 2 * 10**8]
    assert any("stamps are made up, 10 images a second" in note for note in recording.notes)
    assert recording.camera is not None


def test_damaged_and_missing_images_are_counted(tmp_path):
    write_images(tmp_path, ["0.png", "1.png", "2.jpg"], np.uint8)
    (tmp_path / "1.png").write_bytes((tmp_path / "1.png").read_bytes()[:40])
    (tmp_path / "2.jpg").write_bytes(b"no image")
    (tmp_path / "3.png").touch()
    (tmp_path / "images.txt").write_text("0 0.png\n1 1.png\n2 2.jpg\n3 3.png\n4 4.png\nrubbish\n5\n")
    recording = open_recording(tmp_path)
    for _ in range(2):
        assert [f.index for f in recording.frames()] == [0]
        assert dict(recording.problems) == {"compressed image cut short": 1, "compressed image cannot be decoded": 2, "image file missing or unreadable": 1}
    assert any("2 lines" in note for note in recording.notes)


def test_empty_folder_and_empty_list(tmp_path):
    with pytest.raises(InputError, match="no recording in"):
        open_recording(tmp_path)
    (tmp_path / "images.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match="lists no images"):
        open_recording(tmp_path)


def test_topic_of_a_folder_is_an_error(tmp_path):
    write_images(tmp_path, ["0.png"])
    with pytest.raises(InputError, match="no bag"):
        open_recording(tmp_path, "/thermal")


def test_camera_file_that_cannot_be_used_is_noted(tmp_path):
    write_images(tmp_path, ["0.png"])
    (tmp_path / "camera.yaml").write_text("hello: world\n")
    recording = open_recording(tmp_path)
    assert recording.camera is None
    assert any("not used" in note for note in recording.notes)


def test_camera_for_takes_the_file_given_and_checks_the_size(tmp_path):
    write_images(tmp_path, ["0.png"])
    (tmp_path / "camera.yaml").write_text(CAMERA.replace("32", "640"))
    with pytest.raises(CalibrationError, match=r"32x24 but the camera .* is for 640x24"):
        camera_for(open_recording(tmp_path))
    (tmp_path / "k.txt").write_text("30,30,16,12")
    camera = camera_for(open_recording(tmp_path), tmp_path / "k.txt")
    assert camera.image_size == (32, 24)
    chain = "{camera_model: pinhole, intrinsics: [%d, 30, 16, 12], distortion_model: radtan, distortion_coeffs: [0, 0, 0, 0], resolution: [32, 24]}"
    (tmp_path / "chain.yaml").write_text(f"cam0: {chain % 7}\ncam1: {chain % 8}\n")
    assert camera_for(open_recording(tmp_path), f"{tmp_path / 'chain.yaml'}:cam1").matrix[0, 0] == 8


def test_camera_for_a_recording_without_images(tmp_path):
    (tmp_path / "images.txt").write_text("0 gone.png\n")
    with pytest.raises(InputError, match=r"no readable image(.|\n)*1 x image file missing"):
        camera_for(open_recording(tmp_path))


@pytest.mark.parametrize(("text", "stamp"), [("1.5", 1_500_000_000), ("0", 0), ("1403636579763555584", 1403636579763555584), ("1e3", 10**12), ("-2", -2 * 10**9)])
def test_parse_stamp(text, stamp):
    assert parse_stamp(text) == stamp


@pytest.mark.parametrize("text", ["nan", "inf", "x", ""])
def test_parse_stamp_refuses(text):
    with pytest.raises(ValueError, match="no time stamp"):
        parse_stamp(text)


def test_natural_key():
    names = ["f10.png", "f9.png", "F1.png", "1.png", "a.png"]
    assert sorted(names, key=natural_key) == ["1.png", "a.png", "F1.png", "f9.png", "f10.png"]


def write_video(path, count=5, rate=25.0):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate, (64, 48))
    assert writer.isOpened()
    for i in range(count):
        writer.write(np.full((48, 64, 3), 40 * i, np.uint8))
    writer.release()


def test_video(tmp_path):
    write_video(tmp_path / "v.avi")
    recording = open_recording(tmp_path / "v.avi")
    frames: list[Frame] = list(recording.frames())
    assert recording.frame_count == len(frames) == 5
    assert [f.stamp_ns for f in frames] == [i * 40_000_000 for i in range(5)]
    assert all(f.image.shape == (48, 64) and abs(int(f.image[0, 0]) - 40 * f.index) < 4 for f in frames)
    assert not recording.problems


def test_damaged_video(tmp_path):
    (tmp_path / "v.mp4").write_bytes(b"nothing")
    with pytest.raises(InputError, match="ffmpeg"):
        open_recording(tmp_path / "v.mp4")


def test_a_video_of_16_bits_keeps_them(tmp_path):
    depth = [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U, cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    writer = cv2.VideoWriter(str(tmp_path / "v.mkv"), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), 25.0, (64, 48), depth)
    assert writer.isOpened()
    images = [(22_000 + 7 * i + np.arange(48 * 64).reshape(48, 64)).astype(np.uint16) for i in range(3)]
    for image in images:
        writer.write(image)
    writer.release()
    level = cv2.utils.logging.getLogLevel()
    frames = list(open_recording(tmp_path / "v.mkv").frames())
    np.testing.assert_array_equal([f.image for f in frames], images)
    assert frames[0].image.dtype == np.uint16 and cv2.utils.logging.getLogLevel() == level


@pytest.mark.parametrize("line", ["1.5\ta, b.png", "1.5   a, b.png", "1.5,a, b.png", "1.5 , a, b.png", "\ufeff1.5 a, b.png", "1500000000000000000 a, b.png"])
def test_lists_of_any_form(tmp_path, line):
    write_images(tmp_path, ["a, b.png"])
    (tmp_path / "images.txt").write_text(line + "\n", encoding="utf-8")
    recording = open_recording(tmp_path)
    (frame,) = recording.frames()
    assert frame.stamp_ns in (1_500_000_000, 1_500_000_000 * 10**9) and not recording.problems


def test_stamps_that_no_time_can_have_are_told(tmp_path):
    write_images(tmp_path, ["a.png"])
    (tmp_path / "images.txt").write_text("1700000000000.0 a.png\n")
    with pytest.raises(InputError, match="each line must be: seconds"):
        open_recording(tmp_path)
