"""Reference trajectories from the topics of a bag: odometry, tracked transforms, poses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thegra_core.errors import InputError
from thegra_core.evaluation.datasets.sequence import Reference
from thegra_core.geometry.poses import rotation_from_quaternion, transform
from thegra_core.messages import FloatArray
from thegra_core.outputs.trajectory import Trajectory
from thegra_core.sources.bag import header_stamp_ns, topic_counts
from thegra_core.sources.bag_files import open_bag_files

ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
POSE_TYPES = (ODOMETRY, TRANSFORM, POSE, POSE_COVARIANCE)


def pose_topics(paths: Iterable[Path]) -> dict[str, str]:
    """Type of every topic with poses in some bags that holds messages."""
    return {name: kind for path in paths for name, kind, count in topic_counts(path) if kind in POSE_TYPES and count != 0}


def read_bag_poses(paths: Sequence[Path], topic: str, what: str) -> Reference:
    """The poses of one topic of several bags that follow each other, `world_from_body`, stamped by their headers.

    Raises:
        InputError: If there are none.
    """
    poses: dict[int, FloatArray] = {}
    problems: Counter[str] = Counter()
    frames: Counter[str] = Counter()
    for path in paths:
        for file in open_bag_files(path):
            for message in file.messages(topic):
                try:
                    decoded = message.decode()
                except Exception:  # damaged bytes make the deserialiser raise anything
                    problems["cannot be deserialised"] += 1
                    continue
                pose = _pose(decoded, message.type)
                if pose is None:
                    problems["not finite"] += 1
                    continue
                poses[header_stamp_ns(decoded)] = pose
                frames[_body_frame(decoded)] += 1
    if not poses:
        raise InputError(f"topic {topic} holds no usable pose in {', '.join(p.name for p in paths)}; see what they hold with: thegra info {paths[0]}")
    stamps = np.array(sorted(poses), np.int64)
    trajectory = Trajectory(stamps, np.array([poses[stamp] for stamp in stamps.tolist()]))
    rate = 1e9 / float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    body = f", body {frames.most_common(1)[0][0]!r}" if frames.most_common(1)[0][0] else ""
    skipped = "".join(f"; {count} messages {why}" for why, count in problems.items())
    return Reference(trajectory, f"{what} {topic}, {len(stamps)} poses at {rate:.3g} Hz{body}{skipped}")


def _pose(message: Any, kind: str) -> FloatArray | None:
    if kind == TRANSFORM:
        position, orientation = message.transform.translation, message.transform.rotation
    else:
        pose = message.pose if kind == POSE else message.pose.pose
        position, orientation = pose.position, pose.orientation
    numbers = np.array([orientation.x, orientation.y, orientation.z, orientation.w, position.x, position.y, position.z], np.float64)
    if not np.all(np.isfinite(numbers)) or np.linalg.norm(numbers[:4]) < 0.5:
        return None
    return transform(rotation_from_quaternion(numbers[:4]), numbers[4:])


def _body_frame(message: Any) -> str:
    return str(getattr(message, "child_frame_id", ""))
