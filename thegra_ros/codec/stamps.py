"""Stamps and headers."""

from __future__ import annotations

from typing import Any

from builtin_interfaces.msg import Time
from std_msgs.msg import Header

NS_PER_S = 10**9


def time_message(stamp_ns: int) -> Time:
    """Nanoseconds to a stamp.

    Raises:
        ValueError: If a ROS stamp cannot hold it: before 1970, or after January 2038.
    """
    seconds, rest = divmod(stamp_ns, NS_PER_S)
    if not 0 <= seconds < 2**31:
        raise ValueError(f"{stamp_ns} ns is no time that a ROS stamp can hold")
    return Time(sec=seconds, nanosec=rest)


def stamp_ns(message: Any) -> int:
    """Nanoseconds of a message with a header, of a header, or of a stamp."""
    stamp = getattr(message, "header", message)
    stamp = getattr(stamp, "stamp", stamp)
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def header(stamp: int, frame_id: str) -> Header:
    """A header of a time (ns) and a frame."""
    return Header(stamp=time_message(stamp), frame_id=frame_id)
