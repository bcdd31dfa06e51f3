"""Recordings that look like the public data sets: ROS 1 bags with their topics, encodings, file names and calibration files.

Names, topics and calibrations as the sets' pages and public tools give them: ViViD++ (visibilitydataset.github.io), ROVTIO (github.com/ntnu-arl/rovtio).
Ground truth is the camera's pose; the sets' own is that of a marker, LiDAR or vehicle.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer

from thegra_core.geometry.camera import CameraModel, DistortionModel
from thegra_core.geometry.poses import quaternion_from_rotation
from thegra_core.simulation.recording import Simulated, Tick
from thegra_core.simulation.writers.files import write_beside
from thegra_core.simulation.writers.messages import CAMERA_INFO, IMAGE, ODOMETRY, TRANSFORM, Messages

FloatArray = NDArray[np.float64]

VIVID_IMAGE, VIVID_CAMERA = "/thermal/image_raw", "/thermal/camera_info"
ROVTIO_IMAGE, ROVTIO_ODOMETRY, ROVTIO_VICON = "/tau_nodelet/thermal_image", "/aft_mapped_to_init_CORRECTED", "/vicon/charlie/charlie"
ROVTIO_SPLIT_S = 30.0
"""Length of one of ROVTIO's split bags, about."""
_ROVTIO_BEGIN = datetime(2021, 6, 9, 23, 34, 57, tzinfo=timezone.utc)
_ODOMETRY_PERIOD_NS, _VICON_PERIOD_NS = 100_000_000, 166_000_000
_TRANSPORT_NS = 31_000_000
_CSV_HEADER = "time,x,y,z,qx,qy,qz,qw"


def write_vivid(out_dir: Path, recording: Simulated) -> Path:
    """Write as ViViD++'s hand-held sets: `handheld_indoor/dark_<motion>.bag` or `handheld_outdoor/outdoor_<motion>_night1.bag`, the poses as csv in
    `pose/`, Kalibr's file in `calibration/handheld_results/`; beside the bag ground truth and shutter for `thegra run`.

    The bag of the dark aggressive sequence is spelled `dark_aggresive`, as are all "aggresive" pose files of the set.

    Returns:
        The bag.
    """
    motion = "aggresive" if recording.style == "aggressive" else recording.style
    kind, bag_name, pose_name = (
        ("handheld_outdoor", f"outdoor_{motion}_night1.bag", f"path_outdoor_{motion}_night1.csv")
        if recording.outdoors
        else ("handheld_indoor", f"dark_{motion}.bag", f"indoor_{motion}_dark_gt.csv")
    )
    folder = out_dir / kind
    (folder / "pose").mkdir(parents=True)
    messages = Messages(ros1=True)
    truth: list[tuple[int, FloatArray]] = []
    with _bag(folder / bag_name, messages, {VIVID_IMAGE: IMAGE, VIVID_CAMERA: CAMERA_INFO}) as write:
        for tick in recording.ticks:
            _note(truth, tick)
            if tick.image is not None:
                write(VIVID_IMAGE, tick.stamp_ns, messages.image(tick.stamp_ns, tick.image, "thermal"))
                if recording.camera is not None:
                    write(VIVID_CAMERA, tick.stamp_ns, messages.camera_info(tick.stamp_ns, recording.camera, "thermal"))
    (folder / "pose" / pose_name).write_text(pose_csv(truth), encoding="utf-8")
    if recording.camera is not None:
        calibration = out_dir / "calibration" / "handheld_results"
        calibration.mkdir(parents=True)
        (calibration / "camchain-therrgb.yaml").write_text(kalibr_yaml(recording.camera, VIVID_IMAGE), encoding="utf-8")
    write_beside(folder, recording, truth)
    return folder / bag_name


def write_rovtio(out_dir: Path, recording: Simulated) -> Path:
    """Write as a ROVTIO sequence: `m100_charlie_<date>_<N>.bag`, split every 30 s, images as 16UC1 without camera_info, LOAM-like odometry at 10 Hz,
    Vicon-like transforms at 6 Hz; beside the bags camera, ground truth and shutter.

    Returns:
        `out_dir`, the folder of the bags.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    messages = Messages(ros1=True)
    truth: list[tuple[int, FloatArray]] = []
    topics = {ROVTIO_IMAGE: IMAGE, ROVTIO_ODOMETRY: ODOMETRY, ROVTIO_VICON: TRANSFORM}
    due = {ROVTIO_ODOMETRY: 0, ROVTIO_VICON: 0}
    for number, part in enumerate(_split(recording.ticks, round(ROVTIO_SPLIT_S * 1e9))):
        begin = _ROVTIO_BEGIN + timedelta(seconds=number * ROVTIO_SPLIT_S)
        with _bag(out_dir / f"m100_charlie_{begin:%Y-%m-%d-%H-%M-%S}_{number}.bag", messages, topics) as write:
            for tick in part:
                _note(truth, tick)
                if tick.image is not None:
                    encoding = "16UC1" if tick.image.dtype == np.uint16 else "mono8"
                    write(ROVTIO_IMAGE, tick.stamp_ns, messages.image(tick.stamp_ns, tick.image, "thermal", encoding))
                if tick.world_from_camera is None:
                    continue
                if tick.stamp_ns >= due[ROVTIO_ODOMETRY]:
                    due[ROVTIO_ODOMETRY] = tick.stamp_ns + _ODOMETRY_PERIOD_NS
                    write(ROVTIO_ODOMETRY, tick.stamp_ns, messages.odometry(tick.stamp_ns, tick.world_from_camera, "camera_init", "aft_mapped"))
                if tick.stamp_ns >= due[ROVTIO_VICON]:
                    due[ROVTIO_VICON] = tick.stamp_ns + _VICON_PERIOD_NS
                    write(ROVTIO_VICON, tick.stamp_ns, messages.transform(tick.stamp_ns, tick.world_from_camera, "world", "vicon/charlie/charlie"))
    write_beside(out_dir, recording, truth)
    return out_dir


def pose_csv(truth: list[tuple[int, FloatArray]]) -> str:
    """Poses as comma-separated seconds, position and quaternion x y z w, under a header."""
    lines = [_CSV_HEADER]
    for stamp, pose in truth:
        numbers = [*pose[:3, 3], *quaternion_from_rotation(pose[:3, :3])]
        lines.append(f"{stamp // 10**9}.{stamp % 10**9:09d}," + ",".join(f"{value:.9f}" for value in numbers))
    return "\n".join(lines) + "\n"


def kalibr_yaml(camera: CameraModel, topic: str) -> str:
    """A camera as cam0 of a Kalibr camchain."""
    k, fisheye = camera.matrix, camera.model is DistortionModel.EQUIDISTANT
    entry: dict[str, Any] = {
        "camera_model": "pinhole",
        "distortion_coeffs": [float(value) for value in camera.distortion[:4]],
        "distortion_model": "equidistant" if fisheye else "radtan",
        "intrinsics": [float(value) for value in (k[0, 0], k[1, 1], k[0, 2], k[1, 2])],
        "resolution": list(camera.image_size),
        "rostopic": topic,
    }
    return str(yaml.safe_dump({"cam0": entry}, sort_keys=False, default_flow_style=None))


@contextmanager
def _bag(path: Path, messages: Messages, topics: dict[str, str]) -> Iterator[Any]:
    """A function that writes (topic, stamp_ns, message) into a new bag."""
    with Writer(path) as bag:
        connections = {topic: bag.add_connection(topic, name, typestore=messages.typestore) for topic, name in topics.items()}
        yield lambda topic, stamp_ns, message: bag.write(connections[topic], stamp_ns + _TRANSPORT_NS, messages.bytes_of(message, topics[topic]))


def _note(truth: list[tuple[int, FloatArray]], tick: Tick) -> None:
    if tick.world_from_camera is not None:
        truth.append((tick.stamp_ns, tick.world_from_camera))


def _split(ticks: Iterator[Tick], length_ns: int) -> Iterator[list[Tick]]:
    """Ticks in pieces of `length_ns`."""
    piece: list[Tick] = []
    for tick in ticks:
        if piece and tick.stamp_ns - piece[0].stamp_ns >= length_ns:
            yield piece
            piece = []
        piece.append(tick)
    if piece:
        yield piece
