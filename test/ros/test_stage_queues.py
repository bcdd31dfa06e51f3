"""Between the callbacks and the thread of a stage: what may be dropped is answered for, what may not is not."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

import threading
from dataclasses import replace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.parameter import Parameter
from ros_graph import EVERY_IMAGE, NAMESPACE, Graph
from std_msgs.msg import Header

from thegra_core.messages import Frame, Shutter, ShutterState
from thegra_ros.codec.rounds import read_verdict
from thegra_ros.codec.shutter import FrameNotice, read_notice
from thegra_ros.codec.stamps import stamp_ns
from thegra_ros.nodes.preprocessing import PreprocessingNode
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


IMAGES = {"preprocessing.filters": "he_clip", **EVERY_IMAGE, f"qos_overrides.{NAMESPACE}/image_raw.subscription.depth": 1000, "queue_size": 2}


class HeldUp(PreprocessingNode):
    """It takes an image, and the next when it is told to."""

    def __init__(self, **options: Any) -> None:
        super().__init__(parameter_overrides=[Parameter(name, value=value) for name, value in IMAGES.items()], **options)
        self.go_on = threading.Event()

    def work(self, item: tuple[Frame, str]) -> None:
        self.go_on.wait()
        super().work(item)

    def release(self) -> None:
        self.go_on.set()
        super().release()


def test_images_that_come_faster_than_they_are_worked_on_do_not_push_a_new_beginning_out(graph: Graph, frames: list[Frame]) -> None:
    notices = graph.listen(DiagnosticArray, "shutter", LOSSLESS)
    node = graph.add(HeldUp)
    assert node.start()
    graph.wait(lambda: graph._images.get_subscription_count() > 0 and node._notices.get_subscription_count() > 0, "who listens")

    def send(frames: list[Frame]) -> None:
        came = node.health.images
        graph.send(frames)
        graph.wait(lambda: node.health.images == came + len(frames), "images")

    send(frames[:2])
    graph.wait(lambda: node.queue is not None and len(node.queue) == 1, "work on the first")
    past = [replace(frame, stamp_ns=frame.stamp_ns - 10 * 10**9) for frame in frames[:6]]
    send(past)
    node.go_on.set()
    graph.wait(lambda: any(stamp_ns(m) == past[-1].stamp_ns for m in notices), "the last image")
    first = read_notice(notices[0])
    assert first.shutter.stamp_ns == frames[0].stamp_ns
    assert [(stamp_ns(m), read_notice(m).epoch - first.epoch) for m in notices[1:]] == [(frame.stamp_ns, 1) for frame in past[-2:]]
