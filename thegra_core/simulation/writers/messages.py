"""ROS messages of images, cameras and poses, for ROS 1 and ROS 2 alike."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from thegra_core.geometry.camera import CameraModel
from thegra_core.geometry.poses import quaternion_from_rotation
from thegra_core.simulation.recording import ImageArray
from thegra_core.simulation.writers.files import projection

FloatArray = NDArray[np.float64]

IMAGE = "sensor_msgs/msg/Image"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORM = "geometry_msgs/msg/TransformStamped"


class Messages:
    """Makes messages of one ROS version; ROS 1 headers also count."""

    def __init__(self, ros1: bool) -> None:
        self._ros1 = ros1
        self.typestore: Any = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
        self._sequence = 0

    def bytes_of(self, message: Any, name: str) -> bytes:
        """The message as a bag of this ROS version stores it."""
        data = self.typestore.serialize_ros1(message, name) if self._ros1 else self.typestore.serialize_cdr(message, name)
        return bytes(data)

    def image(self, stamp_ns: int, image: ImageArray, frame_id: str, encoding: str | None = None) -> Any:
        """sensor_msgs/Image; encoding by default mono16 or mono8."""
        height, width = image.shape
        wide = image.dtype == np.uint16
        data = np.ascontiguousarray(image, dtype="<u2" if wide else "u1").view(np.uint8).ravel()
        return self._make(
            IMAGE, header=self._header(stamp_ns, frame_id), height=height, width=width, encoding=encoding or ("mono16" if wide else "mono8"), is_bigendian=0,
            step=width * image.itemsize, data=data,
        )  # fmt: skip

    def camera_info(self, stamp_ns: int, camera: CameraModel, frame_id: str) -> Any:
        """sensor_msgs/CameraInfo; ROS 1 writes its matrices in capitals."""
        width, height = camera.image_size
        region = self._make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        matrices = {"d": camera.distortion.copy(), "k": camera.matrix.ravel().copy(), "r": np.eye(3).ravel(), "p": projection(camera).ravel()}
        named = {key.upper() if self._ros1 else key: value for key, value in matrices.items()}
        return self._make(
            CAMERA_INFO, header=self._header(stamp_ns, frame_id), height=height, width=width, distortion_model=camera.model.value, binning_x=0, binning_y=0, roi=region, **named
        )

    def odometry(self, stamp_ns: int, world_from_camera: FloatArray, frame_id: str, child: str) -> Any:
        """nav_msgs/Odometry with the pose; twist and covariances are 0, for unknown."""
        x, y, z = (float(v) for v in world_from_camera[:3, 3])
        pose = self._make("geometry_msgs/msg/Pose", position=self._make("geometry_msgs/msg/Point", x=x, y=y, z=z), orientation=self._quaternion(world_from_camera))
        zero = self._make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self._make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        return self._make(
            ODOMETRY, header=self._header(stamp_ns, frame_id), child_frame_id=child,
            pose=self._make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
            twist=self._make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )  # fmt: skip

    def transform(self, stamp_ns: int, world_from_camera: FloatArray, frame_id: str, child: str) -> Any:
        """geometry_msgs/TransformStamped."""
        x, y, z = (float(v) for v in world_from_camera[:3, 3])
        transform = self._make("geometry_msgs/msg/Transform", translation=self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=z), rotation=self._quaternion(world_from_camera))
        return self._make(TRANSFORM, header=self._header(stamp_ns, frame_id), child_frame_id=child, transform=transform)

    def _make(self, name: str, **fields: Any) -> Any:
        return self.typestore.types[name](**fields)

    def _quaternion(self, world_from_camera: FloatArray) -> Any:
        x, y, z, w = (float(v) for v in quaternion_from_rotation(world_from_camera[:3, :3]))
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        time = self._make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        if not self._ros1:
            return self._make("std_msgs/msg/Header", stamp=time, frame_id=frame_id)
        self._sequence += 1
        return self._make("std_msgs/msg/Header", seq=self._sequence, stamp=time, frame_id=frame_id)
