"""What images and the clock tell of a stream that begins anew."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

from typing import Any

from rclpy.parameter import Parameter
from ros_graph import Graph
from rosgraph_msgs.msg import Clock

from thegra_ros.codec.stamps import time_message
from thegra_ros.diagnostics import Health
from thegra_ros.image_input import ImageInput
from thegra_ros.lifecycle import ManagedNode

MS, S = 10**6, 10**9


class Watching(ManagedNode):
    """Keeps why the stream begins anew."""

    def __init__(self, **options: Any) -> None:
        super().__init__("watching", parameter_overrides=[Parameter("use_sim_time", value=True)], **options)

    def configure(self) -> None:
        self.restarts: list[str] = []
        self._input = ImageInput(self, "raw", Health(), lambda frame, frame_id: None, self.restarts.append)

    def release(self) -> None:
        self._input.close()


def test_a_clock_that_jitters_is_no_beginning_and_one_that_is_set_back_is(graph: Graph) -> None:
    node = graph.add(Watching)
    assert node.start()
    clock = graph.node.create_publisher(Clock, "/clock", 10)

    def is_told(now_ns: int) -> bool:
        clock.publish(Clock(clock=time_message(now_ns)))
        graph.spin_for(0.02)
        return node.get_clock().now().nanoseconds == now_ns

    for now_ns in (100 * S, 100 * S - 1000, 101 * S, 100 * S + 100 * MS):
        graph.wait(lambda now_ns=now_ns: is_told(now_ns), "the clock")
    assert node.restarts == []
    graph.wait(lambda: is_told(50 * S), "the clock")
    assert node.restarts == ["time went back by 50.1 s"]
