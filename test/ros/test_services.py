"""Services: they answer in every state, and keep and find maps."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from rcl_interfaces.srv import SetParameters
from ros_graph import Graph, set_parameter
from std_srvs.srv import SetBool, Trigger

from thegra_ros.codec.poses import pose_matrix
from thegra_ros.codec.stamps import stamp_ns

SERVICES = {"slam": ("reset", "save_map", "load_map"), "mapping": ("save_map", "load_map"), "tracking": ("reset",), "preprocessing": ()}
SWITCHES = {"slam": ("pause", "localization_only"), "mapping": (), "tracking": ("localization_only",), "preprocessing": ("pause",)}


def trigger(graph: Graph, name: str) -> tuple[bool, str]:
    answer = graph.call(Trigger, name, Trigger.Request())
    return answer.success, answer.message


def switch(graph: Graph, name: str, on: bool) -> tuple[bool, str]:
    answer = graph.call(SetBool, name, SetBool.Request(data=on))
    return answer.success, answer.message


def set_map_file(graph: Graph, node: str, path: Path | str) -> None:
    answer = graph.call(SetParameters, f"{node}/set_parameters", SetParameters.Request(parameters=[set_parameter("map_file", str(path))]))
    assert answer.results[0].successful, answer.results[0].reason


@pytest.mark.parametrize("node", SERVICES)
def test_every_service_answers_in_every_state(graph: Graph, node: str, tmp_path: Path) -> None:
    """Without a camera and without a map nearly all is refused, with a reason, and nothing ends the node."""
    process = graph.start(f"thegra_ros.nodes.{node}", {"autostart": "false"})

    def ask_all() -> dict[str, tuple[bool, str]]:
        said = {name: trigger(graph, f"{node}/{name}") for name in SERVICES[node]} | {name: switch(graph, f"{node}/{name}", True) for name in SWITCHES[node]}
        assert all(message for _, message in said.values())
        return said

    for transitions in ((), (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP), (Transition.TRANSITION_UNCONFIGURED_SHUTDOWN,)):
        for transition in transitions:
            assert graph.change_state(transition, node)
        assert {(success, "not configured" in message) for success, message in ask_all().values()} <= {(False, True)}
        if transitions == ():
            assert graph.change_state(Transition.TRANSITION_CONFIGURE, node)
            for state in ("inactive", "active"):
                assert graph.state(node) == state
                said = ask_all()
                assert {name for name, (success, _) in said.items() if success} <= {"reset", "pause"}
                assert "map_file" in said.get("save_map", (False, "map_file"))[1]
                set_map_file(graph, node, tmp_path / "none.map")
                said = ask_all()
                assert "no map yet" in said.get("save_map", (False, "no map yet"))[1] and "camera" in said.get("load_map", (False, "camera"))[1]
                assert "no map yet" in said.get("localization_only", (False, "no map yet"))[1]
                set_map_file(graph, node, "")
                graph.change_state(Transition.TRANSITION_ACTIVATE, node)
            assert graph.change_state(Transition.TRANSITION_DEACTIVATE, node)
            assert graph.change_state(Transition.TRANSITION_CLEANUP, node)
    assert process.end() == 0


@pytest.mark.slow
def test_a_map_is_kept_and_the_camera_found_in_it(graph: Graph, frames, camera, tmp_path: Path) -> None:
    kept = tmp_path / "room.map"
    node = graph.start()
    graph.wait_for_listener()
    graph.send_camera(camera)
    graph.send(frames[:30])
    graph.wait(lambda: graph.processed() == 30)
    poses = {stamp_ns(m): m for m in graph.received["pose"]}
    set_map_file(graph, "slam", kept)
    assert trigger(graph, "slam/save_map") == (True, f"the map is in {kept}")
    assert kept.is_file()

    set_map_file(graph, "slam", tmp_path / "none.map")
    success, why = trigger(graph, "slam/load_map")
    assert not success and "none.map" in why
    graph.send(frames[30:31])
    graph.wait(lambda: len(graph.received["pose"]) > len(poses), "a pose in the map that was there before")

    set_map_file(graph, "slam", kept)
    assert trigger(graph, "slam/load_map")[0]
    assert switch(graph, "slam/localization_only", True)[0]
    before = len(graph.received["pose"])
    graph.send(frames[31:36])
    graph.wait(lambda: graph.processed() == 36)
    assert len(graph.received["pose"]) > before + 2 and graph.value("map grows") == "no"
    success, why = trigger(graph, "slam/reset")
    assert success and str(kept) in why
    assert node.end() == 0

    written = kept.stat().st_mtime_ns
    for key in ("/diagnostics", "pose"):
        graph.received[key].clear()
    again = graph.start(parameters={"map_file": str(kept), "localization_only": "true"})
    graph.wait_for_listener()
    graph.send_camera(camera)
    graph.send(frames[14:20])
    graph.wait(lambda: graph.processed() == 6)
    found = {stamp_ns(m): m for m in graph.received["pose"]}
    assert len(found) >= 4, "found without a map of its own"
    for stamp, message in found.items():
        np.testing.assert_allclose(pose_matrix(message.pose.pose)[:3, 3], pose_matrix(poses[stamp].pose.pose)[:3, 3], atol=0.05)
    assert kept.stat().st_mtime_ns == written and "sought in the map" in again.output
    assert again.end() == 0


def test_localisation_needs_a_map(graph: Graph, tmp_path: Path) -> None:
    node = graph.start(parameters={"autostart": "false", "localization_only": "true", "map_file": str(tmp_path / "none.map")})
    assert not graph.change_state(Transition.TRANSITION_CONFIGURE)
    assert "none.map" in node.output and graph.state() == "unconfigured"
    assert node.end() == 0


def test_a_map_that_cannot_be_used_is_said(graph: Graph, frames, camera, tmp_path: Path) -> None:
    broken = tmp_path / "broken.map"
    broken.write_bytes(os.urandom(100))
    node = graph.start(parameters={"map_file": str(broken)})
    graph.wait_for_listener()
    graph.send_camera(camera)
    graph.send(frames[:1])
    graph.wait(lambda: graph.status is not None and "broken.map" in graph.status.message, "a word about the file")
    assert graph.status.level == DiagnosticStatus.ERROR
    success, why = trigger(graph, "slam/save_map")
    assert not success and "no map yet" in why
    graph.send(frames[1:4])  # the same is true of these
    graph.wait(lambda: graph.value("images") == "4")
    assert trigger(graph, "slam/reset")[0]
    graph.send(frames[4:5])
    graph.wait(lambda: graph.processed() == 1 and "broken.map" not in graph.status.message, "work on a map of its own")
    assert sum("ERROR" in line and "broken.map" in line for line in node.output.splitlines()) == 1
    assert node.end() == 0


@pytest.mark.slow
def test_the_camera_of_a_map_is_found_in_it_also_after_another_camera(graph: Graph, frames, camera, tmp_path: Path) -> None:
    kept = tmp_path / "room.map"
    node = graph.start(parameters={"map_file": str(kept)})
    graph.wait_for_listener()
    graph.send_camera(camera)
    graph.send(frames[:30])
    graph.wait(lambda: graph.processed() == 30)
    assert trigger(graph, "slam/save_map")[0] and node.end() == 0
    for heard in graph.received.values():
        heard.clear()

    node = graph.start(parameters={"map_file": str(kept)})
    graph.wait_for_listener()
    graph.send_camera(replace(camera, matrix=camera.matrix * [[1.5], [1.5], [1.0]]))
    graph.send(frames[14:15])
    graph.wait(lambda: graph.heard(DiagnosticStatus.ERROR, str(kept)), "a word about the camera")
    graph.send_camera(camera)
    graph.send(frames[15:22])
    graph.wait(lambda: graph.processed() == 7)
    graph.wait(lambda: len(graph.received["pose"]) >= 4, "poses in the map")
    graph.wait(lambda: graph.heard(DiagnosticStatus.OK, "tracking"))
    assert node.end() == 0


def test_nothing_begins_where_nothing_works(graph: Graph, camera, tmp_path: Path) -> None:
    graph.environment["THEGRA_WEIGHTS"] = str(tmp_path / "none")
    node = graph.start(parameters={"extractor.name": "xfeat"})
    graph.wait_for_listener()
    graph.send_camera(camera)
    graph.wait(lambda: graph.heard(DiagnosticStatus.ERROR, "thegra weights"), "what is missing")
    success, why = trigger(graph, "slam/reset")
    assert not success and "does not work" in why
    assert node.end() == 0
