"""Small bags for tests, written with rosbags."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"
T0 = 1_700_000_000_000_000_000
RECEIVED_LATER = 123_456_789
K = (100.0, 0.0, 16.0, 0.0, 101.0, 12.0, 0.0, 0.0, 1.0)

Item = tuple[str, str, Any, int]  # topic, type, message, receive time


def picture(i: int, height: int = 24, width: int = 32) -> np.ndarray:
    """A uint16 image that differs from frame to frame."""
    return np.random.default_rng(i).integers(2900, 3300, (height, width)).astype(np.uint16)


def header(store: Any, stamp_ns: int, frame: str = "thermal") -> Any:
    stamp = store.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    seq = {"seq": 0} if store is ROS1 else {}
    return store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **seq)


def image_message(store: Any, image: np.ndarray, stamp_ns: int, encoding: str = "mono16", **fields: Any) -> Any:
    values = {
        "height": image.shape[0], "width": image.shape[1], "encoding": encoding, "is_bigendian": 0,
        "step": image.strides[0], "data": np.frombuffer(image.tobytes(), np.uint8),
    }  # fmt: skip
    return store.types[IMAGE](header=header(store, stamp_ns), **{**values, **fields})


def compressed_message(store: Any, image: np.ndarray, stamp_ns: int, suffix: str = ".png", kind: str = "mono16; png compressed ") -> Any:
    return store.types[COMPRESSED](header=header(store, stamp_ns), format=kind, data=cv2.imencode(suffix, image)[1].ravel())


def info_message(store: Any, stamp_ns: int, k: Iterable[float] = K, model: str = "plumb_bob", d: Iterable[float] = (-0.4, 0.1, 0.0, 0.0, 0.0)) -> Any:
    roi = store.types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    names = {"D": "D", "K": "K", "R": "R", "P": "P"} if store is ROS1 else {"D": "d", "K": "k", "R": "r", "P": "p"}
    arrays = {names["D"]: np.array(list(d)), names["K"]: np.array(list(k)), names["R"]: np.eye(3).ravel(), names["P"]: np.zeros(12)}
    return store.types[INFO](header=header(store, stamp_ns), height=24, width=32, distortion_model=model, binning_x=0, binning_y=0, roi=roi, **arrays)


def stream(store: Any, count: int = 6, topic: str = "/thermal/image_raw", make: Callable[..., Any] = image_message, kind: str = IMAGE) -> list[Item]:
    """`count` images at 10 Hz, received a constant time after they were taken."""
    return [(topic, kind, make(store, picture(i), T0 + i * 10**8), T0 + i * 10**8 + RECEIVED_LATER) for i in range(count)]


def infos(store: Any, topic: str = "/thermal/camera_info", **fields: Any) -> list[Item]:
    return [(topic, INFO, info_message(store, T0, **fields), T0 + RECEIVED_LATER)]


def write_ros1(path: Path, items: list[Item], compression: str | None = None, chunk_bytes: int = 4000) -> Path:
    writer = rosbag1.Writer(path)
    writer.chunk_threshold = chunk_bytes
    if compression:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
    with writer:
        connections: dict[tuple[str, str], Any] = {}
        for topic, kind, message, received in items:
            if (topic, kind) not in connections:
                connections[topic, kind] = writer.add_connection(topic, kind, typestore=ROS1)
            writer.write(connections[topic, kind], received, ROS1.serialize_ros1(message, kind))
    return path


def write_ros2(path: Path, items: list[Item], storage: str = "SQLITE3", compression: str | None = None) -> Path:
    writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[storage])
    if compression:
        writer.set_compression(rosbag2.CompressionMode[compression], rosbag2.CompressionFormat.ZSTD)
    with writer:
        connections: dict[tuple[str, str], Any] = {}
        for topic, kind, message, received in items:
            if (topic, kind) not in connections:
                connections[topic, kind] = writer.add_connection(topic, kind, typestore=ROS2)
            writer.write(connections[topic, kind], received, ROS2.serialize_cdr(message, kind))
    return path
