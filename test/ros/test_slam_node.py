"""The node of the whole system in a real graph: what it publishes is what the offline run finds."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

import signal
from dataclasses import replace

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Path as PathMessage
from ros_graph import OFFLINE, Graph
from sensor_msgs.msg import Image, PointCloud2
from stages import noisy_copies
from std_srvs.srv import SetBool, Trigger

from thegra_core.config import load_config
from thegra_core.messages import TrackingState
from thegra_core.outputs.scoring import align
from thegra_core.outputs.trajectory import read_tum
from thegra_core.slam import Slam
from thegra_ros.codec.clouds import cloud_table
from thegra_ros.codec.poses import path_poses, pose_matrix
from thegra_ros.codec.stamps import stamp_ns
from thegra_ros.qos import RELIABLE
from thegra_ros.transforms import Frames, map_pose


def test_poses_are_those_of_the_offline_run(graph: Graph, frames, camera, recording_path) -> None:
    node = graph.start()
    tracks = graph.listen(Image, "image_tracks", RELIABLE)
    graph.wait_for_listener()
    graph.send_camera(camera)
    graph.send(frames)
    graph.wait(lambda: graph.processed() == len(frames), "all frames")
    graph.wait_for_pose(frames[-1])
    assert graph.value("dropped") == "0" and graph.heard(DiagnosticStatus.OK, "tracking")

    slam = Slam(camera, load_config("fast", overrides=OFFLINE))
    tracked = {r.stamp_ns: r for r in map(slam.process, frames) if r.state is TrackingState.TRACKING}
    live = {stamp_ns(m): m for m in graph.received["pose"]}
    assert len(tracked) > 15 and set(live) == set(tracked)
    for stamp, message in live.items():
        np.testing.assert_allclose(pose_matrix(message.pose.pose), map_pose(tracked[stamp].world_from_camera, Frames()), atol=1e-12)
        assert 0 < message.pose.covariance[0] < 1.0

    odometry = {stamp_ns(m): m for m in graph.received["odometry"]}
    assert set(odometry) == set(live), "no shutter closed: nothing is predicted"
    assert all(m.header.frame_id == "map" and m.child_frame_id == "thermal_camera" for m in odometry.values())
    moving = list(odometry.values())[-5:]
    assert all(np.linalg.norm([m.twist.twist.linear.x, m.twist.twist.linear.y, m.twist.twist.linear.z]) > 0.01 for m in moving)

    along = path_poses(graph.received["path"][-1])
    assert 2 < len(along) <= len(live) and {stamp for stamp, _ in along} <= set(live)
    assert len(path_poses(graph.received["keyframe_path"][-1])) >= 3
    points = cloud_table(graph.received["map_points"][-1]).columns
    distance = np.linalg.norm([points[axis] for axis in "xyz"], axis=0)
    assert len(distance) > 200 and 0.3 < np.median(distance) < 3.0, "around the camera, about one map unit away"
    assert len(tracks) == len(frames) and tracks[-1].encoding == "bgr8"

    truth = dict(zip((t := read_tum(recording_path.parent / "bag" / "groundtruth.txt")).stamps_ns.tolist(), t.poses[:, :3, 3], strict=True))
    found = np.array([[m.pose.pose.position.x, m.pose.pose.position.y, m.pose.pose.position.z] for m in live.values()])
    true = np.array([truth[stamp] for stamp in live])
    alignment = align(found, true)
    errors = alignment.apply(found) - true
    length = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    assert np.sqrt((errors**2).sum(axis=1).mean()) < 0.03 * length
    assert node.end(signal.SIGINT) == 0


def count(message: PathMessage | PointCloud2) -> int:
    return message.width if isinstance(message, PointCloud2) else len(message.poses)


@pytest.mark.slow
def test_reset_pause_and_stamps_that_go_back(graph: Graph, frames, camera) -> None:
    node = graph.start()
    graph.wait_for_listener()
    graph.send_camera(camera)
    graph.send(frames[:22])
    graph.wait(lambda: graph.processed() == 22)
    graph.wait_for_pose(frames[21])
    first = len(graph.received["pose"])
    assert first > 3

    assert graph.call(SetBool, "slam/pause", SetBool.Request(data=True)).success
    graph.send(frames[22:24])
    graph.wait(lambda: graph.value("images") == "24")
    assert graph.status.level == DiagnosticStatus.WARN and "paused" in graph.status.message
    assert graph.call(SetBool, "slam/pause", SetBool.Request(data=False)).success

    told = [stamp_ns(m) for m in graph.received["pose"]]
    graph.send([next(noisy_copies(frames[0], frames[0].stamp_ns - 10**8)), *frames[:22]])  # the bag begins again, with the second of these
    graph.wait(lambda: len(graph.received["pose"]) >= 2 * first, "the same poses in a new map")
    assert [stamp_ns(m) for m in graph.received["pose"]] == [*told, *told]
    assert node.output.count("a new map begins") == 1 and "stamps went back" in node.output

    latched = [graph.received[topic] for topic in ("path", "keyframe_path", "map_points")]
    assert all(count(kept[-1]) for kept in latched)
    assert graph.call(Trigger, "slam/reset", Trigger.Request()).success
    graph.wait(lambda: not any(count(kept[-1]) for kept in latched), "nothing of the old map for who comes later")
    graph.received["/diagnostics"].clear()
    graph.send([replace(frame, stamp_ns=frame.stamp_ns + 10**10) for frame in frames[:2]])
    graph.wait(lambda: graph.heard(DiagnosticStatus.WARN, "no map yet"))
    assert node.end() == 0
