"""The node of the whole system in a real graph."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

import numpy as np

from ros_graph import FAST, Graph

from thegra_core.geometry.poses import inverse
from thegra_core.config import load_config
from thegra_core.messages import TrackingState
from thegra_core.slam import Slam
from thegra_ros.codec.poses import path_poses, pose_matrix
from thegra_ros.codec.stamps import stamp_ns
from thegra_ros.transforms import Frames, map_pose


def test_poses_are_those_of_the_offline_run(graph: Graph, frames, camera) -> None:
    node = graph.start()
    graph.wait_for_listener()
    graph.send_camera(camera)
    graph.send(frames)
    graph.wait(lambda: graph.processed() == len(frames), "all frames")
    config = load_config("fast", overrides={"extractor.name": "orb", "preprocessing.filters": "[{filter: he_clip}]", "loop.enabled": "false"})
    offline = Slam(camera, config)
    results = [offline.process(frame) for frame in frames]
    tracked = {r.stamp_ns: r for r in results if r.state is TrackingState.TRACKING}
    live = {stamp_ns(m): pose_matrix(m.pose.pose) for m in graph.received["pose"]}
    assert len(tracked) > 10
    assert set(live) == set(tracked)
    for stamp, pose in live.items():
        np.testing.assert_allclose(pose, map_pose(tracked[stamp].world_from_camera, Frames()), atol=1e-12)
    print(node.output)
