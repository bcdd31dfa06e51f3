"""What /diagnostics says: whether there is a pose, and if not why and what to do."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from thegra_core.messages import TrackingResult, TrackingState
from thegra_ros.codec.stamps import header
from thegra_ros.lifecycle import ManagedNode
from thegra_ros.qos import RELIABLE

LEVELS = {
    TrackingState.WAITING: DiagnosticStatus.WARN,
    TrackingState.INITIALIZING: DiagnosticStatus.WARN,
    TrackingState.TRACKING: DiagnosticStatus.OK,
    TrackingState.HOLD: DiagnosticStatus.WARN,
    TrackingState.RELOCALIZING: DiagnosticStatus.WARN,
    TrackingState.LOST: DiagnosticStatus.ERROR,
}
"""Only a tracked pose is OK."""
_WORDS = {
    TrackingState.WAITING: "waiting",
    TrackingState.INITIALIZING: "no map yet",
    TrackingState.TRACKING: "tracking",
    TrackingState.HOLD: "shutter closed: the pose on odometry is a prediction",
    TrackingState.RELOCALIZING: "looking for the place after a closure",
    TrackingState.LOST: "lost",
}
COMPLAINT_PERIOD_S = 5.0
"""What keeps a node from working is logged so often."""
SILENCE_S = 2.0
"""Without an image received, or with images of which none is worked on, for so long nothing is OK."""


@dataclass
class Health:
    """The facts that a node collects for its diagnostics; `trouble` and `camera_trouble` say what keeps it from working at all.

    state: Of the tracker. None: the node tracks nothing, and all is well while it works on what comes.
    steady: Images come all the time, so that silence is a fault; keyframes do not.
    unanswered_since_s: When the first image came of those since anything was worked on.
    """

    state: TrackingState | None = None
    reason: str = ""
    paused: bool = False
    trouble: str = ""
    camera_trouble: str = ""
    steady: bool = True
    last_sign_s: float | None = None
    unanswered_since_s: float | None = None
    images: int = 0
    done: int = 0
    bad: Counter[str] = field(default_factory=Counter)
    clock: Callable[[], float] = time.monotonic
    _bad_before: Counter[str] = field(default_factory=Counter)
    _useful: bool = True

    def image_came(self) -> None:
        """An image was received."""
        now_s = self.clock()
        returns = self.steady and self.last_sign_s is not None and now_s - self.last_sign_s > SILENCE_S
        if self.paused:
            self.unanswered_since_s = None
        elif self.unanswered_since_s is None or returns:
            self.unanswered_since_s = now_s
        self.images += 1
        self.last_sign_s = now_s

    def is_of_no_use(self, reason: str) -> None:
        """What is being worked on cannot be used."""
        self.bad[reason] += 1
        self._useful = False

    def worked(self) -> None:
        """What came was worked on; a tracker says by `result_came` whether anything came of it."""
        self.done += 1
        if self.state is None and self._useful:
            self._answered()
        self._useful = True

    def result_came(self, result: TrackingResult) -> bool:
        """What a frame came to; True if that changes what there is to say."""
        changed = result.state is not self.state
        self.state, self.reason = result.state, result.reason
        self._answered()
        return changed

    @property
    def reason_of_late(self) -> str:
        """Why most images since anything was worked on were not, if that is known."""
        of_late = self.bad.copy() - self._bad_before
        return max(of_late, key=of_late.__getitem__, default="")

    def _answered(self) -> None:
        self.last_sign_s, self.unanswered_since_s, self._bad_before = self.clock(), None, self.bad.copy()


class Reporter:
    """Publishes a node's health on /diagnostics every so often, and when told."""

    def __init__(self, node: ManagedNode, health: Health, facts: Callable[[], Mapping[str, object]], period_s: float) -> None:
        self._node, self._health, self._facts = node, health, facts
        self._publisher = node.publisher(DiagnosticArray, "/diagnostics", RELIABLE, always=True)
        node.every(period_s, self.report)

    def report(self) -> None:
        """Publish it now."""
        level, message = judge(self._health) if self._node.active else (DiagnosticStatus.WARN, "the node is not active")
        name = self._node.get_fully_qualified_name().strip("/").replace("/", ": ")
        values = {"images": self._health.images, "processed": self._health.done, **self._facts(), **{f"bad: {k}": v for k, v in sorted(self._health.bad.items())}}
        stamp = self._node.get_clock().now().nanoseconds
        self._publisher.publish(diagnostics_message(stamp, name, level, message, {k: str(v) for k, v in values.items()}))


def judge(health: Health) -> tuple[bytes, str]:
    """Level and message of a node's health at the time of its clock."""
    now_s = health.clock()
    if health.trouble or health.camera_trouble:
        return DiagnosticStatus.ERROR, health.trouble or health.camera_trouble
    if health.paused:
        return DiagnosticStatus.WARN, "paused: images are ignored"
    if health.last_sign_s is None:
        return DiagnosticStatus.WARN, "no image yet"
    if health.steady and now_s - health.last_sign_s > SILENCE_S:
        return DiagnosticStatus.WARN, f"no image for {now_s - health.last_sign_s:.0f} s"
    if health.unanswered_since_s is not None and now_s - health.unanswered_since_s > SILENCE_S:
        return DiagnosticStatus.WARN, _with(f"images come, but none was worked on for {now_s - health.unanswered_since_s:.0f} s", health.reason_of_late)
    if health.state is None:
        return DiagnosticStatus.OK, "working"
    return LEVELS[health.state], _with(_WORDS[health.state], health.reason if health.state is not TrackingState.TRACKING else "")


def _with(words: str, reason: str) -> str:
    return f"{words}: {reason}" if reason else words


def diagnostics_message(stamp_ns: int, name: str, level: bytes, message: str, values: Mapping[str, str]) -> DiagnosticArray:
    """One status as /diagnostics takes it."""
    status = DiagnosticStatus(level=level, name=name, message=message, values=[KeyValue(key=k, value=v) for k, v in values.items()])
    return DiagnosticArray(header=header(stamp_ns, ""), status=[status])
