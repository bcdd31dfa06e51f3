"""When a thermal camera's flat-field shutter is closed, told from the stream alone and causally.

Cameras either go on sending the last image or a blank one while the shutter is down, or send nothing. The first shows as frames that repeat
(sensor noise makes true images of even a static scene differ), the second as a gap in stamps that otherwise come evenly.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from thegra_core.config import ShutterConfig
from thegra_core.messages import Frame, ImageArray, Shutter, ShutterState

_GRID = 8
_MAX_DIFFERENT = 0.001
"""Share of pixels that may differ in a frozen image: an overlay, a flickering pixel."""
_HISTORY = 32
_MIN_PERIODS = 8
_USUAL_WITHIN = 90
_USUAL_RUNS = 3


class ShutterDetector:
    """Tells of each frame whether the camera can see.

    A frame equal to the one before it (at most 0.1 % of the pixels differ), or with all pixels equal, is CLOSED; the frame before the first repeat was
    seen and stays OPEN. The first other frame is JUST_OPENED, as is a frame after a gap of more than `gap_periods` median periods in an even stream.
    Streams whose stamps are whole seconds or uneven (photo flights) have no gaps.

    Streams padded to a higher rate repeat frames all the time: once three runs of repeats have ended within 90 frames, runs at most
    one longer than their median are OPEN. A static scene in 8-bit video can repeat exactly for long; it is called CLOSED, which costs nothing: there is nothing new to see.
    """

    def __init__(self, config: ShutterConfig) -> None:
        self._config = config
        self._previous: Frame | None = None
        self._periods: deque[int] = deque(maxlen=_HISTORY)
        self._whole_seconds = True
        self._state = Shutter.OPEN
        self._repeats = 0
        self._runs: deque[tuple[int, int]] = deque()  # (count of the frame that ended it, length) of runs of repeats
        self._count = 0
        self._last_seen_ns = 0

    def update(self, frame: Frame) -> ShutterState:
        """State at `frame`. Frames whose stamp is not after the last one's say nothing and keep the state."""
        previous = self._previous
        if not self._config.enabled or (previous is not None and frame.stamp_ns <= previous.stamp_ns):
            return ShutterState(frame.stamp_ns, self._state)
        self._count += 1
        self._previous = frame
        repeats = previous is not None and _same(frame.image, previous.image)
        blank = not repeats and _blank(frame.image)
        state, reason = self._blind(repeats) if repeats or blank else self._seeing(frame, previous)
        if previous is not None:
            self._periods.append(frame.stamp_ns - previous.stamp_ns)
        self._whole_seconds &= frame.stamp_ns % 1_000_000_000 == 0
        if not (repeats or blank) or previous is None:
            self._last_seen_ns = frame.stamp_ns
        self._state = Shutter.CLOSED if state is Shutter.CLOSED else Shutter.OPEN
        return ShutterState(frame.stamp_ns, state, reason)

    def _blind(self, repeats: bool) -> tuple[Shutter, str]:
        self._repeats += 1
        if repeats and self._state is not Shutter.CLOSED and self._repeats <= self._usual_run():
            return Shutter.OPEN, "repeated frame, usual in this stream"
        return Shutter.CLOSED, "the image repeats" if repeats else "all pixels are equal"

    def _seeing(self, frame: Frame, previous: Frame | None) -> tuple[Shutter, str]:
        run, self._repeats = self._repeats, 0
        if run:
            self._runs.append((self._count, run))
        if self._state is Shutter.CLOSED:
            return Shutter.JUST_OPENED, f"first new image after {(frame.stamp_ns - self._last_seen_ns) * 1e-9:.2f} s, {run} frames"
        if previous is not None and self._is_gap(frame.stamp_ns - previous.stamp_ns):
            return Shutter.JUST_OPENED, f"gap of {(frame.stamp_ns - previous.stamp_ns) * 1e-9:.2f} s"
        return Shutter.OPEN, ""

    def _usual_run(self) -> int:
        while self._runs and self._runs[0][0] < self._count - _USUAL_WITHIN:
            self._runs.popleft()
        return int(np.median([length for _, length in self._runs])) + 1 if len(self._runs) >= _USUAL_RUNS else 0

    def _is_gap(self, gap_ns: int) -> bool:
        if len(self._periods) < _MIN_PERIODS or self._whole_seconds:
            return False
        low, middle, high = np.percentile(np.fromiter(self._periods, np.float64), [10, 50, 90])
        return bool((high - low) / middle < self._config.max_jitter and gap_ns > self._config.gap_periods * middle)


def _same(image: ImageArray, other: ImageArray) -> bool:
    if image.shape != other.shape or image.dtype != other.dtype:
        return False
    return _mostly_equal(image[::_GRID, ::_GRID], other[::_GRID, ::_GRID]) and _mostly_equal(image, other)


def _mostly_equal(image: ImageArray, other: ImageArray) -> bool:
    return int(np.count_nonzero(image != other)) <= _MAX_DIFFERENT * image.size


def _blank(image: ImageArray) -> bool:
    grid = image[::_GRID, ::_GRID]
    return bool(grid.min() == grid.max() and image.min() == image.max())
