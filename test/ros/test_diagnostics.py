"""What /diagnostics makes of what a node has seen and done."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed: pip install -e .[ros]")

from diagnostic_msgs.msg import DiagnosticStatus

from thegra_core.messages import TrackingResult, TrackingState
from thegra_ros.diagnostics import SILENCE_S, Health, judge

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
PERIOD_S = 0.1
LONG = round(3 * SILENCE_S / PERIOD_S)
"""Images in three times as long as images may go unanswered."""


class Stream:
    """Images of a camera, and a health that sees them."""

    def __init__(self, state: TrackingState | None = None, steady: bool = True) -> None:
        self.now_s = 1000.0
        self.health = Health(state, steady=steady, clock=lambda: self.now_s)

    def come(self, count: int) -> Health:
        """Images that nothing comes of."""
        for _ in range(count):
            self.now_s += PERIOD_S
            self.health.image_came()
        return self.health

    def track(self, count: int = 1, state: TrackingState = TrackingState.TRACKING) -> Health:
        """Images, and a result of each."""
        for _ in range(count):
            self.come(1).worked()
            self.health.result_came(TrackingResult(round(self.now_s * 1e9), state))
        return self.health

    def work(self, count: int = 1) -> Health:
        """Images, each of which is worked on by a stage that does not track."""
        for _ in range(count):
            self.come(1).worked()
        return self.health


def test_ok_while_a_pose_is_tracked_and_no_longer() -> None:
    stream = Stream(TrackingState.WAITING)
    assert judge(stream.health) == (WARN, "no image yet")
    assert judge(stream.come(1)) == (WARN, "waiting")
    assert judge(stream.track(LONG)) == (OK, "tracking")
    assert judge(stream.track(state=TrackingState.LOST))[0] == ERROR
    assert judge(stream.track()) == (OK, "tracking")
    stream.now_s += SILENCE_S + 1
    assert judge(stream.health) == (WARN, "no image for 3 s")


def test_images_of_which_none_is_worked_on_are_not_ok() -> None:
    """The process that works on them stands still: nothing is known of why."""
    stream = Stream(TrackingState.WAITING)
    stream.track(LONG)
    assert judge(stream.come(LONG)) == (WARN, "images come, but none was worked on for 6 s")
    assert judge(stream.track()) == (OK, "tracking")


def test_the_reason_is_the_most_frequent_one_since_the_last_result() -> None:
    stream = Stream(TrackingState.WAITING)
    stream.health.bad["image without a camera"] += 1000
    stream.track(LONG)
    for _ in range(LONG):
        stream.come(1).bad["unknown encoding 'bayer_rggb8'"] += 1
    stream.health.bad["a broken image"] += 1
    assert judge(stream.health) == (WARN, "images come, but none was worked on for 6 s: unknown encoding 'bayer_rggb8'")


def test_a_node_that_says_nothing_of_tracking_is_judged_by_its_work() -> None:
    stream = Stream()
    assert judge(stream.work(LONG)) == (OK, "working")
    assert judge(stream.come(LONG)) == (WARN, "images come, but none was worked on for 6 s")
    assert judge(stream.work()) == (OK, "working")


def test_images_that_are_worked_on_in_vain_are_not_ok() -> None:
    stream = Stream()
    stream.work(LONG)
    for _ in range(LONG):
        stream.come(1).is_of_no_use("stamp repeats")
        stream.health.worked()
    assert judge(stream.health) == (WARN, "images come, but none was worked on for 6 s: stamp repeats")
    assert judge(stream.work()) == (OK, "working")


def test_a_tracker_that_works_but_finds_no_result_is_not_ok() -> None:
    stream = Stream(TrackingState.WAITING)
    stream.track()
    assert judge(stream.work(LONG))[0] == WARN


def test_silence_is_no_fault_where_nothing_comes_steadily() -> None:
    """Keyframes of a camera that stands still: there are none, but each that came has to be worked on."""
    stream = Stream(steady=False)
    stream.work()
    stream.now_s += 100
    assert judge(stream.health) == (OK, "working")
    stream.come(1)
    stream.now_s += SILENCE_S + 1
    assert judge(stream.health) == (WARN, "images come, but none was worked on for 3 s")


def test_time_without_images_and_a_pause_do_not_count() -> None:
    stream = Stream(TrackingState.WAITING)
    stream.track(LONG)
    stream.come(1)
    stream.now_s += 60
    assert judge(stream.come(1)) == (OK, "tracking"), "the camera is back"
    stream.track()
    stream.health.paused = True
    assert judge(stream.come(LONG)) == (WARN, "paused: images are ignored")
    stream.health.paused = False
    assert judge(stream.come(1)) == (OK, "tracking")
