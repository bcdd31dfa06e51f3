"""TF without tf2_ros: transforms are published and read as the messages they are. Where tf2_msgs is not installed nothing of it happens."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry.poses import inverse
from thegra_ros.codec.poses import pose_matrix, transform_message
from thegra_ros.codec.stamps import header, stamp_ns
from thegra_ros.lifecycle import ManagedNode
from thegra_ros.qos import TF, TF_STATIC
from thegra_ros.transforms import Frames, PoseHistory, StampedPose, chain

FloatArray = NDArray[np.float64]


def transform_type() -> Any | None:
    """tf2_msgs/TFMessage, or None where it is not installed."""
    try:
        return importlib.import_module("tf2_msgs.msg").TFMessage
    except ImportError:
        return None


class FixedTransforms:
    """The transforms heard on /tf_static; none where tf2_msgs is not installed."""

    def __init__(self, node: ManagedNode) -> None:
        self._parents: dict[str, tuple[str, FloatArray]] = {}
        kind = transform_type()
        if kind is not None:
            node.listen(kind, "/tf_static", TF_STATIC, self._on_message)

    def find(self, base: str, frame: str) -> FloatArray | None:
        """base_from_frame (4, 4); None where they do not tell."""
        return chain(self._parents, base, frame)

    def _on_message(self, message: Any) -> None:
        for stamped in message.transforms:
            self._parents[stamped.child_frame_id] = (stamped.header.frame_id, pose_matrix(stamped.transform))


class TransformPublisher:
    """Publishes a pose on /tf: map -> odom where an odometry frame is named, else map -> base or map -> camera."""

    def __init__(self, node: ManagedNode, frames: Frames, enabled: bool = True) -> None:
        self._node = node
        self._odometry = PoseHistory()
        self._kind = transform_type() if enabled else None
        self._publisher: Any = None
        self._map_from_odom: FloatArray | None = None
        self._frames = frames
        if enabled and self._kind is None:
            node.get_logger().warning("no transforms: tf2_msgs is not installed (sudo apt install ros-$ROS_DISTRO-tf2-msgs); poses are on the topics all the same")
        if self._kind is not None:
            self._publisher = node.publisher(self._kind, "/tf", TF)
            if frames.odom:
                node.listen(self._kind, "/tf", TF, self._on_moving)

    def publish(self, pose: StampedPose, frames: Frames) -> None:
        """Publish a tracked pose."""
        if not frames.odom:
            self._send(pose.stamp_ns, frames.map, frames.child, pose.map_from_child)
            return
        odom_from_base = self._odometry.at(pose.stamp_ns)
        if odom_from_base is None:
            self._node.get_logger().warning(f"no {frames.map} -> {frames.odom}: nothing tells {frames.odom} -> {frames.base} on /tf at the image's time", throttle_duration_sec=10.0)
            return
        self._map_from_odom = pose.map_from_child @ inverse(odom_from_base)
        self._send(pose.stamp_ns, frames.map, frames.odom, self._map_from_odom)

    def repeat(self, stamp_ns: int, frames: Frames) -> None:
        """While there is no pose the odometry goes on from the last one: map -> odom stays. Nothing else is invented."""
        if frames.odom and self._map_from_odom is not None:
            self._send(stamp_ns, frames.map, frames.odom, self._map_from_odom)

    def forget(self) -> None:
        """The map began anew."""
        self._map_from_odom = None

    def _send(self, stamp: int, parent: str, child: str, parent_from_child: FloatArray) -> None:
        if self._publisher is not None and self._kind is not None:
            self._publisher.publish(self._kind(transforms=[transform_message(header(stamp, parent), child, parent_from_child)]))

    def _on_moving(self, message: Any) -> None:
        for stamped in message.transforms:
            if (stamped.header.frame_id, stamped.child_frame_id) == (self._frames.odom, self._frames.base):
                self._odometry.add(stamp_ns(stamped), pose_matrix(stamped.transform))
