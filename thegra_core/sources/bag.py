"""Image topics of ROS 1 and ROS 2 bags as frames, with the camera their camera_info tells."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from thegra_core.errors import CalibrationError, InputError
from thegra_core.messages import Frame, ImageArray
from thegra_core.sources.bag_files import BagFile, open_bag_files
from thegra_core.sources.bag_walks import RawMessage
from thegra_core.sources.calibration import camera_beside, camera_from_info, is_rectified
from thegra_core.sources.image_decoding import DecodeError, decode_compressed, decode_raw
from thegra_core.sources.recording import ImageTopic, Source
from thegra_core.sources.shutter_flag import FLAG_TYPES, shutter_closed

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_THERMAL = re.compile(r"thermal|lwir|flir|boson|lepton|tau2?_|(^|[/_])tau|infrared|optris|seek|(^|[/_])ir([/_]|$)", re.IGNORECASE)
_NOT_IMAGES = re.compile(r"/(compressedDepth|theora)$|(^|/)[^/]*(depth|disparity|mask)", re.IGNORECASE)


@dataclass
class BagRecording(Source):
    """One image topic of a bag; split bags follow each other."""

    files: list[BagFile] = field(default_factory=list)
    shutter_topic: str | None = None

    def frames(self) -> Iterator[Frame]:
        """Every image that can be decoded, stamped by its header; what cannot is counted in `problems`."""
        self.problems.clear()
        index, closed = -1, None  # type: int, bool | None
        topics = (str(self.topic), *([self.shutter_topic] if self.shutter_topic else []))
        for file in self.files:
            for message in file.messages(*topics):
                if message.topic == self.shutter_topic:
                    closed = self._flag(message, closed)
                    continue
                index += 1
                frame = self._frame(message, index, closed)
                if frame is not None:
                    if frame.stamp_ns == 0:
                        self.note("header stamps are 0: the driver did not fill them in, and without them motion in time is unknown")
                    yield frame
            self.problems.update(file.problems)

    def _flag(self, message: RawMessage, before: bool | None) -> bool | None:
        try:
            return shutter_closed(message.decode())
        except Exception:  # damaged bytes make the deserialiser raise anything
            self.problems["shutter message cannot be deserialised"] += 1
            return before

    def _frame(self, message: RawMessage, index: int, closed: bool | None) -> Frame | None:
        try:
            decoded = message.decode()
            return Frame(header_stamp_ns(decoded), index, decode_message(decoded, message.type), closed)
        except DecodeError as error:
            self.problems[str(error)] += 1
        except Exception:  # damaged bytes make the deserialiser raise anything
            self.problems["message cannot be deserialised"] += 1
        return None


def open_bag(path: Path, topic: str | None = None, shutter_topic: str | None = None) -> BagRecording:
    """Open an image topic of a bag, and the topic that tells of the camera's shutter; see `open_recording`.

    Raises:
        InputError: If nothing can be read, or the topic is missing or cannot be guessed; the message lists the image topics.
    """
    files = open_bag_files(path)
    topics = _image_topics(files)
    damage = "".join(f"\n  {file.damage}" for file in files if file.damage)
    picked, why = _pick(topics, topic, path, damage)
    recording = BagRecording(name=path.resolve().stem, path=path, topic=picked.name, frame_count=picked.count, files=files)
    if shutter_topic is not None:
        recording.shutter_topic = _shutter_topic(files, shutter_topic, path)
    recording.note(why)
    for file in files:
        if file.damage:
            recording.note(file.damage)
    _add_camera(recording, only_image_topic=len(topics) == 1)
    return recording


def bag_image_topics(path: Path) -> list[ImageTopic]:
    """The image topics of a bag.

    Raises:
        InputError: If nothing can be read.
    """
    return _image_topics(open_bag_files(path))


def decode_message(message: Any, kind: str) -> ImageArray:
    """sensor_msgs/Image or CompressedImage to (H, W) uint8, uint16 or float32.

    Raises:
        DecodeError: If it cannot be used.
    """
    if kind == IMAGE:
        return decode_raw(message.data, message.height, message.width, message.encoding, message.step, bool(message.is_bigendian))
    if "compressedDepth" in message.format:
        raise DecodeError("compressedDepth images are not supported")
    return decode_compressed(message.data, message.format.split(";")[0].strip())


def header_stamp_ns(message: Any) -> int:
    """The header's stamp (ns)."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _image_topics(files: list[BagFile]) -> list[ImageTopic]:
    counts: dict[tuple[str, str], int | None] = {}
    for file in files:
        for topic in file.topics:
            if topic.type in (IMAGE, COMPRESSED):
                known = counts.get((topic.name, topic.type), 0)
                counts[topic.name, topic.type] = None if known is None or topic.count is None else known + topic.count
    return [_describe(files, name, kind, count) for (name, kind), count in sorted(counts.items())]


def _describe(files: list[BagFile], name: str, kind: str, count: int | None) -> ImageTopic:
    message = next((m for file in files for m in file.messages(name)), None) if count != 0 else None
    encoding, size = "", None
    try:
        decoded = message.decode() if message else None
        if decoded is not None and kind == IMAGE:
            encoding, size = decoded.encoding, (decoded.width, decoded.height)
        elif decoded is not None:
            height, width = decode_message(decoded, kind).shape
            encoding, size = decoded.format, (width, height)
    except Exception:  # damaged or unsupported: listed without details
        encoding = encoding or "unreadable"
    return ImageTopic(name, kind, count, encoding, size, kind == COMPRESSED)


def _pick(topics: list[ImageTopic], wanted: str | None, path: Path, damage: str) -> tuple[ImageTopic, str]:
    listing = "".join(f"\n  {topic}" for topic in topics)
    if not topics and damage:
        raise InputError(f"no image can be read from {path}:{damage}\na ROS 1 bag may be repaired with `rosbag reindex`, an mcap with `mcap recover`, a db3 with `sqlite3 FILE .recover`")
    if not topics:
        raise InputError(f"{path} holds no image topic (sensor_msgs/Image or CompressedImage)\nsee what it holds with: thegra info {path}")
    if wanted is not None:
        name = "/" + wanted.strip("/")
        found = [t for t in topics if t.name == name] or [t for t in topics if t.compressed and t.name == name + "/compressed"]
        if not found:
            raise InputError(f"{path} has no image topic {wanted!r}; its image topics are:{listing}\ntype: thegra run {path} --topic {_likely(topics).name}")
        return found[0], f"topic {found[0].name}"
    guesses = _guess(topics)
    if len(guesses) != 1:
        raise InputError(f"{path} has several image topics, say which one:{listing}\ntype: thegra run {path} --topic {_likely(topics).name}")
    return guesses[0], f"topic {guesses[0].name}" + (f", guessed among {len(topics)} image topics" if len(topics) > 1 else "")


def _shutter_topic(files: list[BagFile], wanted: str, path: Path) -> str:
    flags = {topic.name: topic.type for file in files for topic in file.topics if topic.type in FLAG_TYPES}
    name = "/" + wanted.strip("/")
    if name not in flags:
        listing = "".join(f"\n  {flag}  {kind}" for flag, kind in sorted(flags.items())) or " none"
        raise InputError(f"{path} has no topic {wanted!r} of a boolean or a whole number, as a shutter's state is; such topics are:{listing}")
    return name


def _guess(topics: list[ImageTopic]) -> list[ImageTopic]:
    """The one topic that fits, or the several that do: raw before its compressed twin, thermal names first, then 16-bit images."""
    filled = [t for t in topics if t.count != 0] or topics
    names = {t.name for t in filled}
    candidates = [t for t in filled if not (t.compressed and t.name.removesuffix("/compressed") in names - {t.name})]
    candidates = [t for t in candidates if not _NOT_IMAGES.search(t.name)] or candidates
    if len(candidates) > 1:
        for narrower in ([t for t in candidates if _THERMAL.search(t.name)], [t for t in candidates if "16" in t.encoding]):
            if len(narrower) == 1:
                return narrower
    return candidates


def _likely(topics: list[ImageTopic]) -> ImageTopic:
    return _guess(topics)[0]


def _add_camera(recording: BagRecording, only_image_topic: bool) -> None:
    infos = sorted({topic.name for file in recording.files for topic in file.topics if topic.type == CAMERA_INFO and topic.count != 0})
    base = str(recording.topic).removesuffix("/compressed").rpartition("/")[0]
    own = f"{base}/camera_info"
    name = own if own in infos else infos[0] if len(infos) == 1 and only_image_topic else None
    if name is not None:
        _camera_from_topic(recording, name)
    folder = recording.path if recording.path.is_dir() else recording.path.parent
    if recording.camera is None:
        recording.camera, notes = camera_beside([folder])
        recording.notes.extend(notes)
    truth = folder / "groundtruth.txt"
    recording.groundtruth = truth if truth.is_file() else None


def _camera_from_topic(recording: BagRecording, name: str) -> None:
    message = next((m for file in recording.files for m in file.messages(name)), None)
    if message is None:
        return
    rectified = is_rectified(str(recording.topic))
    try:
        recording.camera = camera_from_info(message.decode(), rectified)
        matrix, how = ("P", ", of rectified images") if rectified else ("K", "")
        recording.note(f"camera from {name}{how}" if recording.camera else f"{name} says {matrix} = 0: the camera was not calibrated when this was recorded")
    except CalibrationError as error:
        recording.note(f"{name} not used: {error}")
    except Exception:  # damaged bytes make the deserialiser raise anything
        recording.note(f"{name} not used: it cannot be deserialised")


def topic_counts(path: Path) -> list[tuple[str, str, int | None]]:
    """(name, type, messages) of every topic of a bag, for display.

    Raises:
        InputError: If nothing can be read.
    """
    counts: Counter[tuple[str, str]] = Counter()
    unknown: set[tuple[str, str]] = set()
    for file in open_bag_files(path):
        for topic in file.topics:
            counts[topic.name, topic.type] += topic.count or 0
            if topic.count is None:
                unknown.add((topic.name, topic.type))
    return [(name, kind, None if (name, kind) in unknown else count) for (name, kind), count in sorted(counts.items())]
