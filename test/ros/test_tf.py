"""Transforms, published and read as any other node reads them."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")
pytest.importorskip("tf2_msgs.msg", reason="tf2_msgs is not installed: tools/build_tf2_msgs.sh builds it")

from collections.abc import Callable

import numpy as np
from ros_graph import Graph
from stub_node import StubNode
from tf2_msgs.msg import TFMessage

from thegra_core.geometry.poses import so3_exp, transform
from thegra_core.messages import TrackingResult, TrackingState
from thegra_ros.camera_place import CameraPlace
from thegra_ros.codec.poses import path_poses, pose_matrix, transform_message
from thegra_ros.codec.stamps import header, stamp_ns
from thegra_ros.lifecycle import ManagedNode
from thegra_ros.node_config import NodeConfig
from thegra_ros.outputs import PoseOutputs
from thegra_ros.qos import TF, TF_STATIC
from thegra_ros.transforms import BODY_FROM_OPTICAL

S = 10**9
STEP = 0.5
"""Map units that the camera goes ahead from one image to the next."""
BASE_FROM_CAMERA = transform(BODY_FROM_OPTICAL[:3, :3], [0.2, 0.0, 0.3])


class Robot(ManagedNode):
    """Publishes what a tracker would say of a camera that goes straight ahead, along its optical axis."""

    def __init__(self, config: NodeConfig, **options) -> None:
        super().__init__("robot", **options)
        self._config = config

    def configure(self) -> None:
        self.place = CameraPlace(self, self._config)
        self._outputs = PoseOutputs(self, self.place.frames, self._config)

    def move(self, index: int, frame_id: str = "thermal_camera") -> None:
        self.place.see(frame_id)
        ahead = transform(np.eye(3), [0.0, 0.0, STEP * index])
        self._outputs.publish(TrackingResult(index * S, TrackingState.TRACKING, ahead, 1e-4 * np.eye(6), np.zeros(6), map_id=0), self.place.frames)

    def lose(self, index: int) -> None:
        self._outputs.publish(TrackingResult(index * S, TrackingState.LOST), self.place.frames)


@pytest.fixture
def heard(graph: Graph) -> list:
    return graph.listen(TFMessage, "/tf", TF)


def start(graph: Graph, config: NodeConfig) -> Robot:
    robot = graph.add(lambda **options: Robot(config, **options))
    assert robot.start()
    return robot


def until_heard(graph: Graph, heard: list, act: Callable[[], None]) -> None:
    """Do something again until it is heard: a stream finds its listeners."""
    before = len(heard)
    while len(heard) == before:
        act()
        graph.spin_for(0.2)


def links(heard: list) -> set[tuple[str, str]]:
    return {(t.header.frame_id, t.child_frame_id) for message in heard for t in message.transforms}


def test_the_camera_alone(graph: Graph, heard: list) -> None:
    robot = start(graph, NodeConfig())
    until_heard(graph, heard, lambda: robot.move(1))
    assert links(heard) == {("map", "thermal_camera")}
    (last,) = heard[-1].transforms
    assert stamp_ns(last) == 1 * S, "the image's stamp"
    np.testing.assert_allclose(pose_matrix(last.transform)[:3, 3], [STEP, 0, 0], atol=1e-12)
    np.testing.assert_allclose(pose_matrix(last.transform)[:3, 2], [1, 0, 0], atol=1e-12, err_msg="its z axis looks along x of the map")
    count = len(heard)
    robot.lose(2)
    robot.move(3)
    graph.wait(lambda: len(heard) > count)
    assert [stamp_ns(m.transforms[0]) for m in heard[count:]] == [3 * S], "a lost camera has no pose"


def test_forward_is_x_of_the_base(graph: Graph, heard: list) -> None:
    """The camera sits ahead of and above the base, told on /tf_static by way of a link between them; a map unit is two metres."""
    static = graph.node.create_publisher(TFMessage, "/tf_static", TF_STATIC)
    base_from_link = transform(np.eye(3), BASE_FROM_CAMERA[:3, 3])
    parts = (("base_link", "camera_link", base_from_link), ("camera_link", "thermal_camera", BODY_FROM_OPTICAL))
    static.publish(TFMessage(transforms=[transform_message(header(0, parent), child, pose) for parent, child, pose in parts]))
    robot = start(graph, NodeConfig(base_frame="base_link", scale=2.0))
    graph.wait(lambda: robot.place.knows("thermal_camera"), "the static transforms")
    until_heard(graph, heard, lambda: robot.move(1))
    count = len(heard)
    for index in (2, 3):
        robot.move(index)
    graph.wait(lambda: len(heard) >= count + 2)
    assert links(heard) == {("map", "base_link")}
    poses = [pose_matrix(m.transforms[0].transform) for m in heard[-3:]]
    for pose, index in zip(poses, (1, 2, 3), strict=True):
        np.testing.assert_allclose(pose, transform(np.eye(3), [2.0 * STEP * index, 0, 0]), atol=1e-12)


def test_a_place_that_is_told_after_the_first_image_holds_from_there_on(graph: Graph, heard: list) -> None:
    """A camera that looks to the left: until that is told it seems to drive ahead."""
    robot = start(graph, NodeConfig(base_frame="base_link"))
    until_heard(graph, heard, lambda: robot.move(1))
    np.testing.assert_allclose(pose_matrix(heard[-1].transforms[0].transform), transform(np.eye(3), [STEP, 0, 0]), atol=1e-12)
    left = transform(so3_exp([0, 0, np.pi / 2]) @ BODY_FROM_OPTICAL[:3, :3], [-0.4, 0.0, 0.0])
    static = graph.node.create_publisher(TFMessage, "/tf_static", TF_STATIC)
    static.publish(TFMessage(transforms=[transform_message(header(0, "base_link"), "thermal_camera", left)]))
    graph.wait(lambda: robot.place.knows("thermal_camera"), "the static transform")
    count = len(heard)
    for index in (2, 3):
        robot.move(index)
    graph.wait(lambda: len(heard) >= count + 2)
    for message, index in zip(heard[count:], (2, 3), strict=True):
        np.testing.assert_allclose(pose_matrix(message.transforms[0].transform), transform(np.eye(3), [0, STEP * index, 0]), atol=1e-12)
    graph.wait(lambda: any([stamp for stamp, _ in path_poses(m)] == [2 * S, 3 * S] for m in graph.received["path"]), "a path of poses in one frame of reference")


def test_a_place_that_nothing_tells_is_complained_of_until_it_is_told(caplog: pytest.LogCaptureFixture) -> None:
    node = StubNode()
    place = CameraPlace(node, NodeConfig(base_frame="base_link"))

    def complaint() -> str:
        caplog.clear()
        node.let_time_pass()
        return caplog.text

    assert complaint() == "", "no image has come"
    place.see("thermal_camera")
    assert "nothing tells the place of thermal_camera on base_link" in complaint()
    node.tell("/tf_static", TFMessage(transforms=[transform_message(header(0, "base_link"), "thermal_camera", BASE_FROM_CAMERA)]))
    place.see("thermal_camera")
    assert complaint() == ""
    np.testing.assert_allclose(place.frames.base_from_camera, BASE_FROM_CAMERA)


def test_map_to_odom_where_something_else_tells_odometry(graph: Graph, heard: list) -> None:
    """The odometry drifts to the side; map -> odom takes that out, so that map -> odom -> base is the tracked pose."""
    odom_from_base = {i: transform(np.eye(3), [0.9 * 2 * STEP * i, 0.1 * i, 0.0]) for i in range(6)}
    publisher = graph.node.create_publisher(TFMessage, "/tf", TF)
    robot = start(graph, NodeConfig(base_frame="base_link", odom_frame="odom", scale=2.0, base_from_camera="0.2 0 0.3 -0.5 0.5 -0.5 0.5"))

    def drive(index: int) -> None:
        publisher.publish(TFMessage(transforms=[transform_message(header(index * S, "odom"), "base_link", odom_from_base[index])]))
        graph.spin_for(0.1)
        robot.move(index)

    def told() -> list:
        return [t for message in heard for t in message.transforms if t.child_frame_id == "odom"]

    while not told():
        drive(1)
        graph.spin_for(0.2)
    for index in (2, 3):
        count = len(told())
        drive(index)
        graph.wait(lambda n=count: len(told()) > n)
        map_from_odom = pose_matrix(told()[-1].transform)
        np.testing.assert_allclose(map_from_odom @ odom_from_base[index], transform(np.eye(3), [2 * STEP * index, 0, 0]), atol=1e-9)
    assert links(heard) == {("odom", "base_link"), ("map", "odom")}, "base_link has one parent"
    count = len(told())
    robot.lose(4)
    graph.wait(lambda: len(told()) > count, "the odometry goes on")
    last = told()[-1]
    assert stamp_ns(last) == 4 * S
    np.testing.assert_allclose(pose_matrix(last.transform), map_from_odom)
