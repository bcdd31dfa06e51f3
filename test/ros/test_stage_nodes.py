"""The four stages as nodes of their own."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

from collections.abc import Iterator

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from ros_graph import Graph

from thegra_core.messages import Frame, Shutter, ShutterState
from thegra_core.outputs.scoring import align
from thegra_core.outputs.trajectory import read_tum
from thegra_ros.codec.shutter import FrameNotice, notice_message, read_notice
from thegra_ros.codec.stamps import stamp_ns
from thegra_ros.joiner import FrameJoiner

STAGES = ("preprocessing", "frontend", "tracking", "mapping")


@given(st.integers(0, 2**31 * 10**9 - 1), st.sampled_from(Shutter), st.text(st.characters(codec="utf-8", exclude_characters="\0")), st.booleans(), st.integers(0, 99))
def test_notices_are_exact(stamp: int, shutter: Shutter, reason: str, recalibrated: bool, epoch: int) -> None:
    notice = FrameNotice(ShutterState(stamp, shutter, reason, recalibrated), epoch, "thermal_camera")
    assert read_notice(notice_message(notice)) == notice


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


def value(graph: Graph, node: str, key: str) -> int:
    """What a node last said on /diagnostics."""
    for message in reversed(graph.received["/diagnostics"]):
        if message.status[0].name.endswith(node):
            return int(next((v.value for v in message.status[0].values if v.key == key), "0"))
    return 0


def noisy_copies(frame: Frame) -> Iterator[Frame]:
    """Images of a camera that stands still, before the frame's time."""
    rng = np.random.default_rng(0)
    for step in range(600):
        noise = rng.normal(0, 5, frame.image.shape)
        yield Frame(frame.stamp_ns - (600 - step) * 100_000_000, 0, (frame.image + noise).astype(np.uint16))


@pytest.mark.slow
def test_four_nodes_track_and_survive(graph: Graph, frames, camera, recording_path) -> None:
    nodes = {name: graph.start(f"thegra_ros.nodes.{name}") for name in STAGES}
    graph.wait(lambda: all(any(m.status[0].name.endswith(name) and m.status[0].message != "the node is not active" for m in graph.received["/diagnostics"]) for name in STAGES), "four nodes")
    graph.send_camera(camera, listeners=2)
    warm_up = iter(noisy_copies(frames[0]))  # a stream finds its listeners; what is sent before is lost
    while value(graph, "tracking", "processed") == 0:
        graph.send([next(warm_up)])
        graph.spin_for(1.0)
    begin = value(graph, "preprocessing", "images")
    lost = value(graph, "tracking", "lost parts")
    for count, frame in enumerate(frames, 1):  # in step, so that each frame is matched to the newest reference
        done = value(graph, "tracking", "processed")
        graph.send([frame])
        graph.wait(lambda n=done: value(graph, "tracking", "processed") > n, f"frame {count}")
    live = {stamp_ns(m): m for m in graph.received["pose"]}
    assert len(live) > 15 and set(live) <= {f.stamp_ns for f in frames}
    t = read_tum(recording_path.parent / "bag" / "groundtruth.txt")
    truth = dict(zip(t.stamps_ns.tolist(), t.poses[:, :3, 3], strict=True))
    found = np.array([[m.pose.pose.position.x, m.pose.pose.position.y, m.pose.pose.position.z] for m in live.values()])
    true = np.array([truth[stamp] for stamp in live])
    errors = align(found, true).apply(found) - true
    assert np.sqrt((errors**2).sum(axis=1).mean()) < 0.03 * np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    assert graph.received["map_points"] and graph.received["keyframe_path"]
    assert value(graph, "tracking", "lost parts") == lost and value(graph, "mapping", "broken records") == 0

    before = len(graph.received["pose"])  # the bag begins again
    for count, frame in enumerate(frames[:14], 1):
        graph.send([frame])
        graph.wait(lambda n=count: value(graph, "preprocessing", "images") >= begin + len(frames) + n, f"frame {count} again")
    graph.wait(lambda: len(graph.received["pose"]) > before, "poses of a new map")
    assert nodes["preprocessing"].output.count("begins anew") == 1
    assert [node.end() for node in nodes.values()] == [0, 0, 0, 0]
