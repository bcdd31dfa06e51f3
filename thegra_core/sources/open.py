"""One call that opens whatever holds a recording."""

from __future__ import annotations

from pathlib import Path

from thegra_core.errors import InputError
from thegra_core.geometry.camera import CameraModel
from thegra_core.sources.bag import bag_image_topics, open_bag, topic_counts
from thegra_core.sources.bag_files import is_bag
from thegra_core.sources.calibration import check_image_size, load_camera, missing_camera
from thegra_core.sources.folder import find_list, open_images, open_list
from thegra_core.sources.recording import ImageTopic, Recording
from thegra_core.sources.video import SUFFIXES as VIDEO_SUFFIXES
from thegra_core.sources.video import open_video

FORMS = "a ROS 1 .bag, a rosbag2 folder, an .mcap or .db3 file, a folder with images.txt or images, or a video"


def open_recording(path: Path | str, topic: str | None = None, shutter_topic: str | None = None) -> Recording:
    """Open a recording: ROS 1 bag, rosbag2 folder, mcap or db3 file, image folder, or video.

    Args:
        path: The file or folder.
        topic: Image topic of a bag; guessed when only one fits.
        shutter_topic: Topic of a bag by which the camera tells whether its shutter is closed (`shutter_flag`).

    Raises:
        InputError: If the path holds no recording or the topic is missing; the message lists the topics there are.
    """
    path = _existing(path)
    if _holds_bag(path):
        return open_bag(path, topic, shutter_topic)
    for option, value in (("--topic", topic), ("--shutter-topic", shutter_topic)):
        if value is not None:
            raise InputError(f"{option} {value} is given but {path} is no bag and has no topics; leave it out")
    if path.is_dir():
        image_list = find_list(path)
        return open_list(image_list) if image_list is not None else open_images(path)
    if path.suffix.lower() == ".txt":
        return open_list(path)
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return open_video(path)
    raise InputError(f"{path} is {'empty' if path.stat().st_size == 0 else 'no recording'}; give {FORMS}")


def image_topics(path: Path | str) -> list[ImageTopic]:
    """The image topics of a bag; none for folders and videos.

    Raises:
        InputError: If the path does not exist or a bag cannot be read at all.
    """
    path = _existing(path)
    return bag_image_topics(path) if _holds_bag(path) else []


def all_topics(path: Path | str) -> list[tuple[str, str, int | None]]:
    """(name, type, messages or None) of every topic of a bag; none for folders and videos.

    Raises:
        InputError: If the path does not exist or a bag cannot be read at all.
    """
    path = _existing(path)
    return topic_counts(path) if _holds_bag(path) else []


def camera_for(recording: Recording, file: Path | str | None = None, camera: str | None = None) -> CameraModel:
    """The camera of a recording: from `file` when given (`FILE` or `FILE:cam1`), else its own; checked against its first image.

    Raises:
        InputError: If the recording holds no readable image.
        CalibrationError: If nothing tells the intrinsics (the message shows a file to fill in) or they are for another image size.
    """
    first = next(iter(recording.frames()), None)
    if first is None:
        reasons = "".join(f"\n  {count} x {reason}" for reason, count in recording.problems.items())
        raise InputError(f"no readable image in {recording.path}{reasons}\nlook at it with: thegra info {recording.path}")
    height, width = first.image.shape
    if file is not None:
        path, picked = _split_camera(str(file))
        model = load_camera(path, camera or picked, (width, height))
    elif recording.camera is not None:
        model = recording.camera
    else:
        raise missing_camera(str(recording.path), width, height)
    check_image_size(model, first.image.shape)
    return model


def _existing(path: Path | str) -> Path:
    path = Path(path).expanduser()
    if not path.exists():
        raise InputError(f"{path} does not exist; give {FORMS}")
    return path


def _holds_bag(path: Path) -> bool:
    if path.is_file():
        return is_bag(path)
    return (path / "metadata.yaml").is_file() or (find_list(path) is None and any(f.is_file() and is_bag(f) for f in path.iterdir()))


def _split_camera(text: str) -> tuple[Path, str | None]:
    head, _, tail = text.rpartition(":")
    return (Path(head), tail) if head and not Path(text).exists() else (Path(text), None)
