"""A steady 8-bit picture of a stream: the window's limits move slowly, so that the picture does not flicker and what enters it does not crush the rest."""

from __future__ import annotations

import math

NS_PER_S = 1e9


class SteadyWindow:
    """Carries the limits of a window from frame to frame.

    Each limit follows that of the newest frame with time constant `seconds`, as if it were at most one window's width away: a hot object that fills the
    image moves the window by a small share of its width a frame, however hot it is, while small changes are followed smoothly.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._limits: tuple[float, float] | None = None
        self._stamp_ns = 0

    def update(self, limits: tuple[float, float], stamp_ns: int) -> tuple[float, float]:
        """The limits to use for the frame at `stamp_ns`, whose own are `limits`. The first frame, and one after a step back in time, has its own."""
        before = self._limits
        elapsed_s = (stamp_ns - self._stamp_ns) / NS_PER_S
        self._stamp_ns = stamp_ns
        if before is None or elapsed_s < 0 or not before[1] > before[0]:
            self._limits = limits
            return limits
        share, width = -math.expm1(-elapsed_s / self._seconds), before[1] - before[0]
        low, high = (old + share * min(max(new - old, -width), width) for old, new in zip(before, limits, strict=True))
        self._limits = (low, high)
        return self._limits

    def reset(self) -> None:
        """Begin anew with the next frame: after a shutter closure, which sets the counts to another level."""
        self._limits = None
