"""What the world gets: pose, odometry and path of each tracked frame; points and keyframes of the map; an image with the tracks."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Header

from thegra_core.messages import MapSummary, Snapshot, TrackingResult, TrackingState
from thegra_ros.codec.clouds import cloud_message
from thegra_ros.codec.images import image_message
from thegra_ros.codec.poses import odometry, path_message, pose_with_covariance
from thegra_ros.codec.stamps import header
from thegra_ros.lifecycle import ManagedNode
from thegra_ros.node_config import NodeConfig
from thegra_ros.qos import LATCHED, RELIABLE
from thegra_ros.tf import TransformPublisher
from thegra_ros.transforms import Frames, map_points, map_pose, stamped_pose

FloatArray = NDArray[np.float64]
PATH_PERIOD_NS = 200_000_000
"""The path is sent five times a second at the most: a long one is a large message."""


class ThinningPath:
    """Poses of one map over time; when there are too many, every second one goes."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._stride = 1
        self._count = 0
        self._poses: list[tuple[int, FloatArray]] = []

    def add(self, stamp_ns: int, pose: FloatArray) -> None:
        """Add the pose of a frame."""
        if self._count % self._stride == 0:
            self._poses.append((stamp_ns, pose))
        self._count += 1
        if len(self._poses) > self._most:
            self._poses = self._poses[::2]
            self._stride *= 2

    def clear(self) -> None:
        """Begin anew."""
        self._stride, self._count, self._poses = 1, 0, []

    def poses(self) -> list[tuple[int, FloatArray]]:
        """(stamp_ns, (4, 4)) in order of time."""
        return list(self._poses)


class PoseOutputs:
    """Publishes `pose`, `odometry`, `path` and TF."""

    def __init__(self, node: ManagedNode, frames: Frames, config: NodeConfig) -> None:
        self._pose = node.publisher(PoseWithCovarianceStamped, "pose", RELIABLE)
        self._odometry = node.publisher(Odometry, "odometry", RELIABLE)
        self._path_publisher = node.publisher(Path, "path", LATCHED)
        self.transforms = TransformPublisher(node, frames, config.publish_tf)
        self._path = ThinningPath(config.path_length)
        self._frames = frames
        self._map_id: int | None = None
        self._path_sent_ns = 0

    def publish(self, result: TrackingResult, frames: Frames) -> None:
        """Publish a result: a tracked pose everywhere, a predicted one on `odometry` only and with a variance that says so, else nothing.

        Other frames than before (the camera's place was heard) are another frame of reference, as a new map is.
        """
        if frames is not self._frames:
            self._begin_anew()
            self._frames = frames
        if result.world_from_camera is None or result.state not in (TrackingState.TRACKING, TrackingState.HOLD):
            self.transforms.repeat(result.stamp_ns, frames)
            return
        predicted = result.state is TrackingState.HOLD
        pose = stamped_pose(result.stamp_ns, result.world_from_camera, result.covariance, result.twist, frames, predicted)
        stamped = header(result.stamp_ns, frames.map)
        if predicted:
            self._odometry.publish(odometry(stamped, frames.child, pose))
            self.transforms.repeat(result.stamp_ns, frames)
            return
        if result.map_id != self._map_id:
            self._begin_anew()
            self._map_id = result.map_id
        self._pose.publish(pose_with_covariance(stamped, pose))
        self._odometry.publish(odometry(stamped, frames.child, pose))
        self.transforms.publish(pose, frames)
        self._path.add(result.stamp_ns, pose.map_from_child)
        if not 0 <= result.stamp_ns - self._path_sent_ns < PATH_PERIOD_NS:
            self._path_sent_ns = result.stamp_ns
            self._path_publisher.publish(path_message(stamped, self._path.poses()))

    def forget(self) -> None:
        """The map began anew: the old path is in no frame any more, and who comes later gets an empty one."""
        if self._path_sent_ns:
            self._path_publisher.publish(path_message(header(self._path_sent_ns, self._frames.map), []))
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._path.clear()
        self._path_sent_ns = 0
        self._map_id = None
        self.transforms.forget()


class MapOutputs:
    """Publishes `map_points` and `keyframe_path`."""

    def __init__(self, node: ManagedNode) -> None:
        self._points = node.publisher(PointCloud2, "map_points", LATCHED)
        self._keyframes = node.publisher(Path, "keyframe_path", LATCHED)
        self._shown: Header | None = None

    def publish(self, stamp_ns: int, summary: MapSummary, frames: Frames) -> None:
        """Publish a map."""
        self._shown = header(stamp_ns, frames.map)
        keyframes = zip(summary.keyframe_stamps_ns.tolist(), (map_pose(pose, frames) for pose in summary.keyframe_poses), strict=True)
        self._send(self._shown, map_points(summary.points_world, frames), summary.point_scores, keyframes)

    def forget(self) -> None:
        """The map began anew: who comes later gets an empty one."""
        if self._shown is not None:
            self._send(self._shown, np.empty((0, 3)), np.empty(0), [])
            self._shown = None

    def _send(self, stamped: Header, points: FloatArray, scores: NDArray[np.floating], keyframes: Iterable[tuple[int, FloatArray]]) -> None:
        x, y, z = points.astype(np.float32).T
        self._points.publish(cloud_message(stamped, {"x": x, "y": y, "z": z, "intensity": scores.astype(np.float32)}))
        self._keyframes.publish(path_message(stamped, keyframes))


class TracksOutput:
    """Publishes `image_tracks` while someone looks."""

    def __init__(self, node: ManagedNode) -> None:
        self._publisher = node.publisher(Image, "image_tracks", RELIABLE)

    @property
    def wanted(self) -> bool:
        """Whether someone looks."""
        return bool(self._publisher.get_subscription_count())

    def publish(self, view: Snapshot, frame_id: str) -> None:
        """Publish an image with its keypoints and tracks."""
        self._publisher.publish(image_message(header(view.stamp_ns, frame_id), draw_tracks(view)))


def draw_tracks(view: Snapshot) -> NDArray[np.uint8]:
    """(H, W, 3) blue, green, red: keypoints grey, those that see a landmark green, with a line from where the reference keyframe has them."""
    canvas: NDArray[Any] = cv2.cvtColor(view.image, cv2.COLOR_GRAY2BGR)
    for (x, y), tracked, (px, py) in zip(view.keypoints.tolist(), view.tracked.tolist(), view.previous.tolist(), strict=True):
        centre = (round(x), round(y))
        if tracked and np.isfinite(px):
            cv2.line(canvas, (round(px), round(py)), centre, (0, 160, 0), 1, cv2.LINE_AA)
        cv2.circle(canvas, centre, 2, (0, 255, 0) if tracked else (128, 128, 128), 1, cv2.LINE_AA)
    return canvas
