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
"""Without an image received or worked on for so long nothing is OK."""


@dataclass
class Health:
    """The facts that a node collects for its diagnostics; `trouble` and `camera_trouble` say what keeps it from working at all."""

    state: TrackingState = TrackingState.WAITING
    reason: str = ""
    paused: bool = False
    trouble: str = ""
    camera_trouble: str = ""
    last_sign_s: float | None = None
    images: int = 0
    done: int = 0
    bad: Counter[str] = field(default_factory=Counter)

    def image_came(self) -> None:
        """An image was received."""
        self.images += 1
        self.last_sign_s = time.monotonic()

    def result_came(self, result: TrackingResult) -> bool:
        """What a frame came to; True if that changes what there is to say."""
        changed = result.state is not self.state
        self.state, self.reason = result.state, result.reason
        self.last_sign_s = time.monotonic()
        return changed


class Reporter:
    """Publishes a node's health on /diagnostics every so often, and when told."""

    def __init__(self, node: ManagedNode, health: Health, facts: Callable[[], Mapping[str, object]], period_s: float) -> None:
        self._node, self._health, self._facts = node, health, facts
        self._publisher = node.publisher(DiagnosticArray, "/diagnostics", RELIABLE, always=True)
        node.every(period_s, self.report)

    def report(self) -> None:
        """Publish it now."""
        level, message = judge(self._health, time.monotonic()) if self._node.active else (DiagnosticStatus.WARN, "the node is not active")
        name = self._node.get_fully_qualified_name().strip("/").replace("/", ": ")
        values = {"images": self._health.images, "processed": self._health.done, **self._facts(), **{f"bad: {k}": v for k, v in sorted(self._health.bad.items())}}
        stamp = self._node.get_clock().now().nanoseconds
        self._publisher.publish(diagnostics_message(stamp, name, level, message, {k: str(v) for k, v in values.items()}))


def judge(health: Health, now_s: float) -> tuple[bytes, str]:
    """Level and message of a node's health at a monotonic time (s)."""
    if health.trouble or health.camera_trouble:
        return DiagnosticStatus.ERROR, health.trouble or health.camera_trouble
    if health.paused:
        return DiagnosticStatus.WARN, "paused: images are ignored"
    if health.last_sign_s is None:
        return DiagnosticStatus.WARN, "no image yet"
    if now_s - health.last_sign_s > SILENCE_S:
        return DiagnosticStatus.WARN, f"no image for {now_s - health.last_sign_s:.0f} s"
    words = _WORDS[health.state]
    return LEVELS[health.state], f"{words}: {health.reason}" if health.reason and health.state is not TrackingState.TRACKING else words


def diagnostics_message(stamp_ns: int, name: str, level: bytes, message: str, values: Mapping[str, str]) -> DiagnosticArray:
    """One status as /diagnostics takes it."""
    status = DiagnosticStatus(level=level, name=name, message=message, values=[KeyValue(key=k, value=v) for k, v in values.items()])
    return DiagnosticArray(header=header(stamp_ns, ""), status=[status])
