"""Poses, uncertainties and velocities."""

from __future__ import annotations

from typing import Any

import numpy as np
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Twist,
    TwistWithCovariance,
    Vector3,
)
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from std_msgs.msg import Header

from thegra_core.geometry.poses import quaternion_from_rotation, rotation_from_quaternion, transform
from thegra_ros.codec.stamps import header as make_header
from thegra_ros.codec.stamps import stamp_ns
from thegra_ros.transforms import StampedPose

FloatArray = NDArray[np.float64]


def pose_message(a_from_b: FloatArray) -> Pose:
    """(4, 4) rigid transform as the pose of b in a."""
    x, y, z, w = quaternion_from_rotation(a_from_b[:3, :3]).tolist()
    px, py, pz = a_from_b[:3, 3].tolist()
    return Pose(position=Point(x=px, y=py, z=pz), orientation=Quaternion(x=x, y=y, z=z, w=w))


def pose_matrix(pose: Pose | Transform) -> FloatArray:
    """(4, 4) of a pose or transform message."""
    position, q = (pose.position, pose.orientation) if isinstance(pose, Pose) else (pose.translation, pose.rotation)
    return transform(rotation_from_quaternion([q.x, q.y, q.z, q.w]), [position.x, position.y, position.z])


def covariance_message(covariance: FloatArray) -> NDArray[np.float64]:
    """(6, 6) as messages hold it: 36 numbers, row by row. The order is theirs already: x, y, z, rotations about x, y, z."""
    return np.ascontiguousarray(covariance, dtype=np.float64).ravel()


def pose_with_covariance(header: Header, pose: StampedPose) -> PoseWithCovarianceStamped:
    """Pose and uncertainty."""
    return PoseWithCovarianceStamped(header=header, pose=PoseWithCovariance(pose=pose_message(pose.map_from_child), covariance=covariance_message(pose.covariance)))


def odometry(header: Header, child_frame: str, pose: StampedPose) -> Odometry:
    """Pose and velocity, each with uncertainty; the velocity is in the child frame."""
    vx, vy, vz, wx, wy, wz = pose.twist.tolist()
    twist = Twist(linear=Vector3(x=vx, y=vy, z=vz), angular=Vector3(x=wx, y=wy, z=wz))
    return Odometry(
        header=header, child_frame_id=child_frame, pose=PoseWithCovariance(pose=pose_message(pose.map_from_child), covariance=covariance_message(pose.covariance)),
        twist=TwistWithCovariance(twist=twist, covariance=covariance_message(pose.twist_covariance)),
    )  # fmt: skip


def path_message(header: Header, stamped_poses: Any) -> Path:
    """Path of (stamp_ns, (4, 4) pose in the header's frame)."""
    return Path(header=header, poses=[PoseStamped(header=make_header(stamp, header.frame_id), pose=pose_message(pose)) for stamp, pose in stamped_poses])


def path_poses(path: Path) -> list[tuple[int, FloatArray]]:
    """(stamp_ns, (4, 4)) of each pose of a path."""
    return [(stamp_ns(stamped), pose_matrix(stamped.pose)) for stamped in path.poses]


def transform_message(header: Header, child_frame: str, parent_from_child: FloatArray) -> TransformStamped:
    """A transform for TF: header.frame_id is the parent."""
    pose = pose_message(parent_from_child)
    translation = Vector3(x=pose.position.x, y=pose.position.y, z=pose.position.z)
    return TransformStamped(header=header, child_frame_id=child_frame, transform=Transform(translation=translation, rotation=pose.orientation))
