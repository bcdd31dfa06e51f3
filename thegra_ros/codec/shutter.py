"""The shutter's state, and which run of the stream a frame belongs to, as a DiagnosticArray."""

from __future__ import annotations

from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from thegra_core.messages import Shutter, ShutterState
from thegra_ros.codec.stamps import header, stamp_ns


@dataclass(frozen=True, slots=True)
class FrameNotice:
    """What preprocessing says of each frame. Another `epoch` than before: the stream begins anew."""

    shutter: ShutterState
    epoch: int
    frame_id: str


def notice_message(notice: FrameNotice) -> DiagnosticArray:
    """As a message."""
    state = notice.shutter
    values = {"state": state.shutter.value, "recalibrated": str(state.recalibrated).lower(), "epoch": str(notice.epoch)}
    level = DiagnosticStatus.WARN if state.shutter is Shutter.CLOSED else DiagnosticStatus.OK
    status = DiagnosticStatus(level=level, name="shutter", message=state.reason, values=[KeyValue(key=k, value=v) for k, v in values.items()])
    return DiagnosticArray(header=header(state.stamp_ns, notice.frame_id), status=[status])


def read_notice(message: DiagnosticArray) -> FrameNotice:
    """The inverse of `notice_message`."""
    (status,) = message.status
    values = {value.key: value.value for value in status.values}
    state = ShutterState(stamp_ns(message), Shutter(values["state"]), status.message, values["recalibrated"] == "true")
    return FrameNotice(state, int(values["epoch"]), message.header.frame_id)
