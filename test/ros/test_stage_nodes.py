"""The four stages as nodes of their own."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

import os
import signal

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from hypothesis import given
from hypothesis import strategies as st
from lifecycle_msgs.msg import Transition
from rcl_interfaces.srv import SetParameters
from ros_graph import OFFLINE, Graph, children, set_parameter
from stages import STAGES, Stages, again
from std_srvs.srv import SetBool, Trigger

from thegra_core.config import load_config
from thegra_core.messages import Shutter, ShutterState, TrackingState
from thegra_core.outputs.scoring import align
from thegra_core.outputs.trajectory import read_tum
from thegra_core.slam import Slam
from thegra_ros.codec.poses import pose_matrix
from thegra_ros.codec.shutter import FrameNotice, notice_message, read_notice
from thegra_ros.codec.stamps import stamp_ns
from thegra_ros.joiner import MOST_PENDING, FrameJoiner
from thegra_ros.transforms import Frames, map_pose


@given(st.integers(0, 2**31 * 10**9 - 1), st.sampled_from(Shutter), st.text(st.characters(codec="utf-8", exclude_characters="\0")), st.booleans(), st.integers(0, 99))
def test_notices_are_exact(stamp: int, shutter: Shutter, reason: str, recalibrated: bool, epoch: int) -> None:
    notice = FrameNotice(ShutterState(stamp, shutter, reason, recalibrated), epoch, "thermal_camera")
    assert read_notice(notice_message(notice)) == notice


def test_what_nothing_announces_is_forgotten() -> None:
    joined = joiner()
    for stamp in range(3 * MOST_PENDING):
        assert joined.add("features", stamp, "f") == []
    assert joined.lost == 2 * MOST_PENDING


def joiner() -> FrameJoiner:
    return FrameJoiner("notice", lambda parts: "features" in parts or parts.get("notice") == "closed", lambda parts: parts.get("notice") == "closed")


def test_parts_are_joined_in_whatever_order_they_come() -> None:
    joined = joiner()
    assert joined.add("features", 1, "f1") == []
    assert joined.add("notice", 1, "open") == [{"features": "f1", "notice": "open"}]
    assert joined.add("notice", 2, "open") == []
    assert joined.add("notice", 3, "closed") == [], "not before the frame ahead of it"
    assert joined.add("features", 2, "f2") == [{"notice": "open", "features": "f2"}, {"notice": "closed"}]
    assert joined.lost == 0


def test_a_frame_that_lost_a_part_holds_nothing_up() -> None:
    joined = joiner()
    joined.add("notice", 1, "open")
    joined.add("notice", 2, "open")
    assert joined.add("features", 2, "f2") == [{"notice": "open", "features": "f2"}]
    assert joined.lost == 1


FOLLOWING = {"flow.enabled": "true", "tracking.match_by": "nearest"}


@pytest.mark.slow
@pytest.mark.parametrize("following", [{}, FOLLOWING], ids=["detecting in each image", "following keypoints"])
def test_four_nodes_track_and_survive(graph: Graph, frames, camera, recording_path, following: dict[str, str]) -> None:
    stages = Stages(graph, camera, frames[0], **dict.fromkeys(STAGES, following))
    lost = stages.value("tracking", "lost parts")
    stages.send(frames)
    graph.wait_for_pose(frames[-1])
    live = {stamp_ns(m): m for m in graph.received["pose"]}
    assert len(live) > 15 and set(live) <= {f.stamp_ns for f in frames}
    slam = Slam(camera, load_config("fast", overrides=OFFLINE | following))
    alone = {r.stamp_ns: r for r in map(slam.process, frames) if r.state is TrackingState.TRACKING}
    assert set(alone) == set(live)
    for stamp, message in live.items():
        np.testing.assert_allclose(pose_matrix(message.pose.pose), map_pose(alone[stamp].world_from_camera, Frames()), atol=1e-9)
    t = read_tum(recording_path.parent / "bag" / "groundtruth.txt")
    truth = dict(zip(t.stamps_ns.tolist(), t.poses[:, :3, 3], strict=True))
    found = np.array([[m.pose.pose.position.x, m.pose.pose.position.y, m.pose.pose.position.z] for m in live.values()])
    true = np.array([truth[stamp] for stamp in live])
    errors = align(found, true).apply(found) - true
    assert np.sqrt((errors**2).sum(axis=1).mean()) < 0.03 * np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    assert graph.received["map_points"] and graph.received["keyframe_path"]
    assert stages.value("tracking", "lost parts") == lost and stages.value("mapping", "broken records") == 0
    told = {(s.name.rpartition(" ")[2], s.message) for m in graph.received["/diagnostics"] for s in m.status if s.level == DiagnosticStatus.OK}
    assert told == {("preprocessing", "working"), ("frontend", "working"), ("tracking", "tracking"), ("mapping", "working")}

    graph.received["pose"].clear()  # the bag begins again
    stages.begin_again(frames[0])
    stages.send(frames[:18])
    expected = {stamp for stamp in live if stamp <= frames[17].stamp_ns}
    graph.wait(lambda: {stamp_ns(m) for m in graph.received["pose"]} == expected, "the same poses in a new map")
    assert stages.nodes["preprocessing"].output.count("begins anew") == 2
    assert stages.end() == [0, 0, 0, 0]


@pytest.mark.slow
def test_a_node_that_is_killed_and_started_again_is_taken_back(graph: Graph, frames, camera, tmp_path) -> None:
    stages = Stages(graph, camera, frames[0], mapping={"engine": "process"})
    stages.send(frames[:20])
    graph.wait_for_pose(frames[19])
    maps = stages.value("mapping", "maps")

    kept = tmp_path / "room.map"
    set_map_file = SetParameters.Request(parameters=[set_parameter("map_file", str(kept))])
    assert graph.call(SetParameters, "mapping/set_parameters", set_map_file).results[0].successful
    answer = graph.call(Trigger, "mapping/save_map", Trigger.Request())
    assert answer.success and kept.is_file(), answer.message

    for name in ("tracking", "frontend", "preprocessing"):
        stages.restart(name, camera)
        stages.poses_come(frames[20:24], 2, f"poses with a new {name}")
        assert stages.value("mapping", "maps") == maps, "no new map was begun"
    assert "sought in the map" in stages.nodes["tracking"].output

    def new_map_begins() -> None:
        begun = stages.nodes["tracking"].output.count("a new map begins")
        stages.send_until(again(frames), lambda: stages.nodes["tracking"].output.count("a new map begins") > begun, "a new map")

    (keeper,) = children(stages.nodes["mapping"].process.pid)  # it has the map: a new one begins
    os.kill(keeper, signal.SIGKILL)
    new_map_begins()
    assert "killed; out of memory?" in stages.nodes["mapping"].output
    stages.restart("mapping", camera)
    new_map_begins()
    assert graph.call(SetParameters, "mapping/set_parameters", set_map_file).results[0].successful
    answer = graph.call(Trigger, "mapping/load_map", Trigger.Request())
    assert answer.success, answer.message
    stages.poses_come(frames[14:22], 3, "poses in the map that was loaded")
    assert graph.call(SetBool, "tracking/localization_only", SetBool.Request(data=True)).success
    assert stages.end() == [0, 0, 0, 0]


@pytest.mark.slow
def test_tracking_goes_on_when_mapping_does(graph: Graph, frames, camera) -> None:
    """With an answer that only comes late it goes on as it was; a keyframe that mapping did not take, as it was not active, is in the map of neither."""
    stages = Stages(graph, camera, frames[0])
    stages.send(frames[:20])
    graph.wait_for_pose(frames[19])
    tracking, mapping = stages.nodes["tracking"], stages.nodes["mapping"].process
    to_and_fro = [*frames[20:], *frames[-2:20:-1]]
    begun = tracking.output.count("tracking begins again")

    def wait_in_vain() -> None:
        said = tracking.output.count("waiting for the node mapping")
        stages.send_until(again(to_and_fro), lambda: tracking.output.count("waiting for the node mapping") > said, "a keyframe without an answer")

    os.kill(mapping.pid, signal.SIGSTOP)
    wait_in_vain()
    os.kill(mapping.pid, signal.SIGCONT)
    stages.poses_come(to_and_fro, 20, "poses, the answer being there")

    assert graph.change_state(Transition.TRANSITION_DEACTIVATE, "mapping")
    wait_in_vain()
    assert tracking.output.count("tracking begins again") == begun
    maps = stages.value("mapping", "maps")
    assert graph.change_state(Transition.TRANSITION_ACTIVATE, "mapping")
    stages.poses_come(frames[16:22], 3, "poses in the map that mapping has kept")
    assert tracking.output.count("tracking begins again") == begun + 1 and "sought in the map" in tracking.output
    assert stages.value("mapping", "maps") == maps, "no new map was begun"
    assert stages.end() == [0, 0, 0, 0]
