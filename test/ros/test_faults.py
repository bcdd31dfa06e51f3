"""What goes wrong in the field does not end the node, and is said."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

import os
import signal
from dataclasses import replace

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from rcl_interfaces.srv import SetParameters
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_graph import NAMESPACE, Graph, children, set_parameter
from sensor_msgs.msg import CameraInfo, Image
from stages import again

from thegra_core.geometry.camera import CameraModel
from thegra_ros.codec.stamps import stamp_ns
from thegra_ros.transforms import UNKNOWN_VARIANCE


@pytest.mark.slow
def test_bad_input_is_said_and_survived(graph: Graph, frames, camera: CameraModel) -> None:
    node = graph.start()
    graph.wait_for_listener()

    graph.send(frames[:2])  # before camera_info
    graph.wait(lambda: graph.value("bad: image without a camera") == "2")
    graph.wait(lambda: graph.heard(DiagnosticStatus.ERROR, "no camera_info on /thegra/camera_info"))

    without = replace_matrix(camera, 0.0)  # K of a driver without a calibration
    graph.send_camera(without, until=lambda: graph.heard(DiagnosticStatus.ERROR, "not calibrated"))
    assert graph.heard(DiagnosticStatus.ERROR, "camera_file")

    graph.send_camera(camera)
    graph.send(frames[2:4], encoding="bayer_rggb8")
    graph.wait(lambda: graph.value("bad: unknown encoding 'bayer_rggb8'") == "2")

    graph.send(frames[4:14])
    graph.wait(lambda: graph.processed() == 10)
    small = [replace(frame, image=frame.image[:128]) for frame in frames[14:16]]  # the driver changes its mode
    graph.send(small)
    graph.wait(lambda: graph.processed() == 12)
    graph.wait(lambda: graph.heard(DiagnosticStatus.WARN, "size") or graph.heard(DiagnosticStatus.ERROR, "size"))

    cropped = CameraModel(camera.matrix, camera.distortion, camera.model, (320, 128), camera.name)
    graph.send_camera(cropped)
    graph.send([replace(frame, image=frame.image[:128]) for frame in frames[16:]])
    graph.wait(lambda: graph.processed() == 12 + len(frames[16:]))
    assert "a new map begins" in node.output and "320x128" in node.output
    assert node.end() == 0


@pytest.mark.slow
def test_a_camera_that_stops_and_returns(graph: Graph, frames, camera) -> None:
    node = graph.start()
    graph.wait_for_listener()
    graph.send_camera(camera)
    graph.send(frames[:20])
    graph.wait(lambda: graph.processed() == 20)
    graph.wait_for_pose(frames[19])
    before = len(graph.received["pose"])
    assert before > 3
    graph.wait(lambda: graph.heard(DiagnosticStatus.WARN, "no image for"), "a word about the silence")
    assert len(graph.received["pose"]) == before, "no pose without an image"
    seen_again = [replace(frame, stamp_ns=frame.stamp_ns + 60 * 10**9) for frame in frames[16:22]]
    graph.send(seen_again)
    graph.wait(lambda: graph.processed() == 26)
    graph.wait(lambda: len(graph.received["pose"]) >= before + 3, "poses of the camera that is back")
    assert graph.value("map") == "0"
    assert "new map" not in node.output
    assert node.end() == 0


def replace_matrix(camera: CameraModel, factor: float) -> CameraModel:
    made = CameraModel(camera.matrix, camera.distortion, camera.model, camera.image_size, camera.name)
    object.__setattr__(made, "matrix", camera.matrix * factor)  # the model itself refuses such a matrix
    return made


@pytest.mark.slow
def test_a_closed_shutter_puts_nothing_on_pose(graph: Graph, frames, camera) -> None:
    node = graph.start()
    graph.wait_for_listener()
    graph.send_camera(camera)
    closed = [replace(frame, image=np.full_like(frame.image, 7000)) for frame in frames[22:25]]
    graph.send([*frames[:22], *closed])
    graph.wait(lambda: graph.processed() == 25)
    graph.wait(lambda: graph.heard(DiagnosticStatus.WARN, "prediction"))
    stamps = {frame.stamp_ns for frame in closed}
    graph.wait(lambda: sum(stamp_ns(m) in stamps for m in graph.received["odometry"]) == len(closed), "three predictions")
    claimed = {stamp_ns(m) for m in graph.received["pose"]}
    assert claimed and not claimed & stamps
    predicted = [m for m in graph.received["odometry"] if stamp_ns(m) in stamps]
    assert all(m.pose.covariance[0] >= UNKNOWN_VARIANCE for m in predicted)
    assert node.end() == 0


@pytest.mark.slow
def test_lifecycle_requests_that_are_invalid_end_nothing(graph: Graph, frames, camera) -> None:
    node = graph.start(parameters={"autostart": "false"})
    assert graph.state() == "unconfigured"
    assert not graph.change_state(Transition.TRANSITION_ACTIVATE), "not before it is configured"
    assert not graph.change_state(99)
    assert graph.state() == "unconfigured"
    for _ in range(2):
        assert graph.change_state(Transition.TRANSITION_CONFIGURE)
        refused = graph.call(SetParameters, "slam/set_parameters", SetParameters.Request(parameters=[set_parameter("keyframe.rotation_deg", 5.0)]))
        assert not refused.results[0].successful and "clean it up" in refused.results[0].reason
        assert graph.change_state(Transition.TRANSITION_ACTIVATE)
        graph.wait_for_listener()
        graph.send_camera(camera)
        before = len(graph.received["pose"])
        graph.send(frames[:22])
        graph.wait(lambda: graph.processed() == 22)
        graph.wait(lambda n=before: len(graph.received["pose"]) > n, "poses")
        assert graph.change_state(Transition.TRANSITION_DEACTIVATE)
        assert graph.change_state(Transition.TRANSITION_CLEANUP)
        graph.received["/diagnostics"].clear()
    out_of_range = graph.call(SetParameters, "slam/set_parameters", SetParameters.Request(parameters=[set_parameter("extractor.max_keypoints", 1)]))
    assert not out_of_range.results[0].successful
    accepted = graph.call(SetParameters, "slam/set_parameters", SetParameters.Request(parameters=[set_parameter("keyframe.rotation_deg", 5.0)]))
    assert accepted.results[0].successful
    assert graph.change_state(Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
    assert node.end() == 0


def test_a_transition_that_fails_says_why(graph: Graph, tmp_path) -> None:
    node = graph.start(parameters={"autostart": "false", "camera_file": str(tmp_path / "none.yaml")})
    assert not graph.change_state(Transition.TRANSITION_CONFIGURE)
    assert graph.state() == "unconfigured"
    assert "none.yaml" in node.output
    assert node.end() == 0


@pytest.mark.slow
def test_sigterm_during_work(graph: Graph, frames, camera) -> None:
    node = graph.start()
    graph.wait_for_listener()
    graph.send_camera(camera)
    graph.send(frames)
    graph.wait(lambda: graph.processed() >= 1)
    assert graph.processed() < len(frames), "there is work left"
    assert node.end(signal.SIGTERM) == 0


@pytest.mark.slow
def test_the_engine_is_started_again_when_it_dies(graph: Graph, frames, camera) -> None:
    node = graph.start(parameters={"engine": "process"})
    graph.wait_for_listener()
    graph.send_camera(camera)
    graph.send(frames[:12])
    graph.wait(lambda: graph.processed() == 12)
    (engine,) = children(node.process.pid)
    os.kill(engine, signal.SIGKILL)
    before = len(graph.received["pose"])
    graph.send(frames[12:13])  # the one that meets the dead engine
    graph.wait(lambda: "a new map begins" in node.output, "a word about the engine")
    assert "out of memory" in node.output
    coming = again(frames)
    while len(graph.received["pose"]) <= before:  # no faster than the first map is solved beside them
        done = graph.processed()
        graph.send([next(coming)])
        graph.wait(lambda n=done: graph.processed() > n, "the frame")
    assert node.end() == 0


def test_ends_that_do_not_fit_are_told(graph: Graph) -> None:
    """A node that asks for reliable images, and a driver that sends best effort."""
    node = graph.start(parameters={f"qos_overrides.{NAMESPACE}/image_raw.subscription.reliability": "reliable"})
    graph.node.create_publisher(Image, "image_raw", QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT))
    graph.wait(lambda: "no data between" in node.output, "a word about the misfit")
    assert f"qos_overrides.{NAMESPACE}/image_raw.subscription.reliability" in node.output
    assert node.end() == 0


def test_a_topic_that_brings_nothing_is_told_with_those_that_are_there(graph: Graph) -> None:
    """The user's first mistake: the camera publishes elsewhere."""
    graph.node.create_publisher(Image, "/boson/image_raw", 5)
    graph.node.create_publisher(CameraInfo, "/boson/camera_info", 5)
    node = graph.start(extra=["-r", "image_raw:=/camera/image_raw", "-r", "camera_info:=/camera/camera_info"])
    graph.wait(lambda: "nobody publishes /camera/image_raw; Image is on /boson/image_raw" in node.output)
    graph.wait(lambda: "nobody publishes /camera/camera_info; CameraInfo is on /boson/camera_info" in node.output)
    assert node.end() == 0
