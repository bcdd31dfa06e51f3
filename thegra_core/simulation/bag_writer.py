"""Writes a recording as a rosbag2 folder (mcap) with camera_info and ground truth, and beside the bag `groundtruth.txt` and `camera.yaml`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from thegra_core.errors import InputError
from thegra_core.geometry.camera import CameraModel
from thegra_core.geometry.poses import quaternion_from_rotation

FloatArray = NDArray[np.float64]

IMAGE_TOPIC = "/thermal/image_raw"
CAMERA_TOPIC = "/thermal/camera_info"
TRUTH_TOPIC = "/ground_truth/odometry"
CAMERA_FRAME = "thermal_camera"
WORLD_FRAME = "world"
TRANSPORT_NS = 23_000_000
"""Time from exposure to receipt, ns: receive times differ from header stamps, as in every real recording."""


def write_bag(folder: Path, camera: CameraModel, frames: Iterable[tuple[int, NDArray[np.uint16], FloatArray]]) -> Path:
    """Write frames (stamp_ns, image (H, W) uint16, world_from_camera (4, 4)) in the order given.

    Returns:
        `folder`, which is a rosbag2 recording.

    Raises:
        InputError: If the folder exists already.
    """
    if folder.exists():
        raise InputError(f"{folder} exists already: remove it or name another folder")
    folder.parent.mkdir(parents=True, exist_ok=True)
    types = get_typestore(Stores.ROS2_JAZZY)
    truth: list[tuple[int, FloatArray]] = []
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topics = {IMAGE_TOPIC: "sensor_msgs/msg/Image", CAMERA_TOPIC: "sensor_msgs/msg/CameraInfo", TRUTH_TOPIC: "nav_msgs/msg/Odometry"}
        connections = {topic: bag.add_connection(topic, name, typestore=types) for topic, name in topics.items()}
        for stamp_ns, image, world_from_camera in frames:
            messages = {
                IMAGE_TOPIC: _image(types, stamp_ns, image),
                CAMERA_TOPIC: _camera_info(types, stamp_ns, camera),
                TRUTH_TOPIC: _odometry(types, stamp_ns, world_from_camera),
            }
            for topic, message in messages.items():
                bag.write(connections[topic], stamp_ns + TRANSPORT_NS, types.serialize_cdr(message, topics[topic]))
            truth.append((stamp_ns, world_from_camera))
    (folder / "groundtruth.txt").write_text(tum_text(truth), encoding="utf-8")
    (folder / "camera.yaml").write_text(camera_yaml(camera), encoding="utf-8")
    return folder


def tum_text(poses: Iterable[tuple[int, FloatArray]]) -> str:
    """Poses as lines `stamp tx ty tz qx qy qz qw` (TUM), stamps in seconds with 9 decimals."""
    lines = ["# stamp tx ty tz qx qy qz qw (world_from_camera, metres)"]
    for stamp_ns, pose in poses:
        values = [*pose[:3, 3], *quaternion_from_rotation(pose[:3, :3])]
        lines.append(f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d} " + " ".join(f"{value:.9f}" for value in values))
    return "\n".join(lines) + "\n"


def camera_yaml(camera: CameraModel) -> str:
    """A camera as the YAML file that ROS's camera_calibration writes."""
    width, height = camera.image_size
    values = {
        "image_width": width,
        "image_height": height,
        "camera_name": camera.name or CAMERA_FRAME,
        "camera_matrix": _matrix(camera.matrix),
        "distortion_model": camera.model.value,
        "distortion_coefficients": _matrix(camera.distortion[None]),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(_projection(camera)),
    }
    return str(yaml.safe_dump(values, sort_keys=False, default_flow_style=None))


def _matrix(values: FloatArray) -> dict[str, Any]:
    return {"rows": values.shape[0], "cols": values.shape[1], "data": [float(v) for v in values.ravel()]}


def _projection(camera: CameraModel) -> FloatArray:
    return np.concatenate([camera.matrix, np.zeros((3, 1))], axis=1)


def _header(types: Any, stamp_ns: int, frame_id: str) -> Any:
    time = types.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return types.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)


def _image(types: Any, stamp_ns: int, image: NDArray[np.uint16]) -> Any:
    height, width = image.shape
    little_endian = np.ascontiguousarray(image, dtype="<u2")
    return types.types["sensor_msgs/msg/Image"](
        header=_header(types, stamp_ns, CAMERA_FRAME),
        height=height,
        width=width,
        encoding="mono16",
        is_bigendian=0,
        step=2 * width,
        data=little_endian.view(np.uint8).ravel(),
    )


def _camera_info(types: Any, stamp_ns: int, camera: CameraModel) -> Any:
    width, height = camera.image_size
    region = types.types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return types.types["sensor_msgs/msg/CameraInfo"](
        header=_header(types, stamp_ns, CAMERA_FRAME),
        height=height,
        width=width,
        distortion_model=camera.model.value,
        d=camera.distortion.copy(),
        k=camera.matrix.ravel().copy(),
        r=np.eye(3).ravel(),
        p=_projection(camera).ravel(),
        binning_x=0,
        binning_y=0,
        roi=region,
    )


def _odometry(types: Any, stamp_ns: int, world_from_camera: FloatArray) -> Any:
    vector, point, quaternion = (types.types[f"geometry_msgs/msg/{name}"] for name in ("Vector3", "Point", "Quaternion"))
    x, y, z, w = (float(v) for v in quaternion_from_rotation(world_from_camera[:3, :3]))
    position = point(*(float(v) for v in world_from_camera[:3, 3]))
    pose = types.types["geometry_msgs/msg/Pose"](position=position, orientation=quaternion(x=x, y=y, z=z, w=w))
    twist = types.types["geometry_msgs/msg/Twist"](linear=vector(0.0, 0.0, 0.0), angular=vector(0.0, 0.0, 0.0))
    unknown = np.zeros(36)
    return types.types["nav_msgs/msg/Odometry"](
        header=_header(types, stamp_ns, WORLD_FRAME),
        child_frame_id=CAMERA_FRAME,
        pose=types.types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=unknown),
        twist=types.types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=unknown),
    )
