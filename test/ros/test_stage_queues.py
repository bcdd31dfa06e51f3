"""Between the callbacks and the thread of a stage: what may be dropped is answered for, what may not is not."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

from rclpy.parameter import Parameter
from ros_graph import Graph
from std_msgs.msg import Header

from thegra_core.messages import Shutter, ShutterState
from thegra_ros.codec.rounds import read_verdict
from thegra_ros.codec.shutter import FrameNotice
from thegra_ros.codec.stamps import stamp_ns
from thegra_ros.nodes.tracking import TrackingNode
from thegra_ros.qos import LOSSLESS


class BusyTracking(TrackingNode):
    """Its thread does not come to what waits."""

    def load(self) -> None:
        self.stopping.wait()


def test_frontend_hears_of_a_followed_frame_that_is_pushed_out(graph: Graph) -> None:
    """As by the notices of a shutter that closes while tracking waits for mapping: frontend takes no image before that."""
    said = graph.listen(Header, "wanted", LOSSLESS)
    tracking = graph.add(lambda **options: BusyTracking(parameter_overrides=[Parameter("queue_size", value=2)], **options))
    assert tracking.start()
    graph.wait(lambda: tracking._verdicts.get_subscription_count() > 0, "who listens")
    for stamp, shutter in enumerate((Shutter.CLOSED, Shutter.OPEN, Shutter.CLOSED, Shutter.CLOSED, Shutter.CLOSED), 1):
        followed = {"followed": True} if shutter is Shutter.OPEN else {}
        tracking.enqueue({"notice": FrameNotice(ShutterState(stamp, shutter), 1, "thermal_camera"), **followed})
    graph.wait(lambda: bool(said), "a word of the frame")
    assert [(stamp_ns(m), read_verdict(m)) for m in said] == [(2, None)]
