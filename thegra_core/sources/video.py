"""Video files through OpenCV."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2

from thegra_core.errors import InputError
from thegra_core.messages import Frame
from thegra_core.sources.calibration import camera_beside
from thegra_core.sources.image_decoding import DecodeError, from_array
from thegra_core.sources.recording import Source

_GRAY16LE = int.from_bytes(b"Y1\x00\x10", "little")
"""FFmpeg's tag of images of one channel and 16 bits, as FFV1 stores them."""
SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".m4v", ".mpg", ".mpeg", ".webm", ".ts", ".wmv")


@dataclass
class VideoRecording(Source):
    """A video file; stamps are the container's presentation times, from 0."""

    rate_hz: float = 0.0

    def frames(self) -> Iterator[Frame]:
        """Every frame that can be decoded."""
        self.problems.clear()
        capture = _opened(self.path)
        index = 0
        try:
            while True:
                ok, image = capture.read()
                if not ok:
                    break
                position_ms = capture.get(cv2.CAP_PROP_POS_MSEC)
                stamp_ns = round(position_ms * 1e6) if position_ms > 0 or index == 0 else round(index * 1e9 / self.rate_hz)
                try:
                    yield Frame(stamp_ns, index, from_array(image))
                except DecodeError as error:
                    self.problems[str(error)] += 1
                index += 1
        finally:
            capture.release()
        if self.frame_count and index < self.frame_count:
            self.problems["video frame missing: the file promises more than it holds"] += self.frame_count - index


def _opened(path: Path) -> cv2.VideoCapture:
    """Images of 16 bits as they are stored, which OpenCV would else cut to 8; others as OpenCV converts them."""
    capture = cv2.VideoCapture(str(path))
    if int(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)) != _GRAY16LE:
        return capture
    capture.release()
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # it warns of formats that this is none of
    try:
        return cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_CONVERT_RGB, 0])
    finally:
        cv2.utils.logging.setLogLevel(level)


def open_video(path: Path) -> VideoRecording:
    """Open a video file.

    Raises:
        InputError: If OpenCV cannot open it.
    """
    capture = _opened(path)
    try:
        if not capture.isOpened():
            raise InputError(f"{path} cannot be opened as a video: it is damaged or its codec is unknown here; convert it with: ffmpeg -i {path} images/%06d.png")
        count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        rate = float(capture.get(cv2.CAP_PROP_FPS))
    finally:
        capture.release()
    camera, notes = camera_beside([path.parent])
    recording = VideoRecording(name=path.stem, path=path, camera=camera, frame_count=count if count > 0 else None, rate_hz=rate if rate > 0 else 25.0)
    for note in (*notes, "stamps are the video's presentation times, from 0"):
        recording.note(note)
    return recording
