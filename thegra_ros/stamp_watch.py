"""Tells a stream that begins anew (a bag that loops, a clock set back) from single stamps out of order."""

from __future__ import annotations

from collections import deque

LEAST_JUMP_NS = 10**9
_REMEMBERED = 3


class StampWatch:
    """Looks at every stamp once.

    A new beginning is two stamps in a row, ascending, that lie `LEAST_JUMP_NS` before each of the last stamps. Comparing with several of them keeps one
    stamp far in the future from making all that follow look like the past.
    """

    def __init__(self) -> None:
        self._last: deque[int] = deque(maxlen=_REMEMBERED)
        self._suspect_ns: int | None = None

    def begins_anew(self, stamp_ns: int) -> bool:
        """Whether the stream begins anew with this stamp."""
        behind = bool(self._last) and stamp_ns < min(self._last) - LEAST_JUMP_NS
        if not behind:
            self._suspect_ns = None
            self._last.append(stamp_ns)
            return False
        if self._suspect_ns is None or stamp_ns <= self._suspect_ns:
            self._suspect_ns = stamp_ns
            return False
        self._last.clear()
        self._last.extend((self._suspect_ns, stamp_ns))
        self._suspect_ns = None
        return True

    def forget(self) -> None:
        """Begin anew without a word."""
        self._last.clear()
        self._suspect_ns = None
