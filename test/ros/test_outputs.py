"""What is published of results and maps, and what of them stays when a map begins anew."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

import importlib.util

import numpy as np
from stub_node import StubNode

from thegra_core.geometry.poses import transform
from thegra_core.messages import MapSummary, TrackingResult, TrackingState
from thegra_ros.codec.clouds import cloud_table
from thegra_ros.codec.poses import path_poses, transform_message
from thegra_ros.codec.stamps import header, stamp_ns
from thegra_ros.node_config import NodeConfig
from thegra_ros.outputs import MapOutputs, PoseOutputs
from thegra_ros.transforms import Frames

S = 10**9
FRAMES = Frames(camera="thermal_camera")
DRIVING = Frames(odom="odom", base="base_link", camera="thermal_camera")


def tracked(second: int, map_id: int = 0) -> TrackingResult:
    return TrackingResult(second * S, TrackingState.TRACKING, transform(np.eye(3), [0.0, 0.0, second]), 1e-4 * np.eye(6), np.zeros(6), map_id=map_id)


def lost(second: int) -> TrackingResult:
    return TrackingResult(second * S, TrackingState.LOST)


def test_a_map_that_begins_anew_leaves_an_empty_path() -> None:
    node = StubNode()
    outputs = PoseOutputs(node, FRAMES, NodeConfig(publish_tf=False))
    outputs.forget()
    assert node.sent["path"] == [], "there was none"
    for second in (1, 2):
        outputs.publish(tracked(second), FRAMES)
    outputs.forget()
    outputs.forget()
    outputs.publish(tracked(3), FRAMES)
    assert [[stamp // S for stamp, _ in path_poses(path)] for path in node.sent["path"]] == [[1], [1, 2], [], [3]]
    assert {path.header.frame_id for path in node.sent["path"]} == {"map"}


def test_a_map_that_begins_anew_leaves_no_points() -> None:
    node = StubNode()
    outputs = MapOutputs(node)
    outputs.forget()
    assert node.sent["map_points"] == [], "there were none"
    outputs.publish(1 * S, MapSummary(0, np.array([1 * S]), np.eye(4)[None], np.ones((5, 3)), np.ones(5, np.float32)), FRAMES)
    outputs.forget()
    outputs.forget()
    assert [cloud.width for cloud in node.sent["map_points"]] == [5, 0]
    assert [len(path.poses) for path in node.sent["keyframe_path"]] == [1, 0]
    first, last = (set(cloud_table(cloud).columns) for cloud in node.sent["map_points"])
    assert first == last == {"x", "y", "z", "intensity"}


@pytest.mark.skipif(importlib.util.find_spec("tf2_msgs") is None, reason="tf2_msgs is not installed: tools/build_tf2_msgs.sh builds it")
def test_map_to_odom_goes_on_from_the_first_pose_of_a_map() -> None:
    from tf2_msgs.msg import TFMessage

    node = StubNode()
    outputs = PoseOutputs(node, DRIVING, NodeConfig(base_frame="base_link", odom_frame="odom"))
    for second in range(1, 8):
        node.tell("/tf", TFMessage(transforms=[transform_message(header(second * S, "odom"), "base_link", np.eye(4))]))
    for result in (tracked(1), lost(2), tracked(3), lost(4), tracked(5, map_id=1), lost(6)):
        outputs.publish(result, DRIVING)
    outputs.forget()
    outputs.publish(lost(7), DRIVING)
    assert [stamp_ns(m.transforms[0]) // S for m in node.sent["/tf"]] == [1, 2, 3, 4, 5, 6], "of a map that is forgotten nothing is repeated"
