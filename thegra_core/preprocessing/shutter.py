"""When a thermal camera's flat-field shutter is closed, told from the stream alone and causally.

Cameras either go on sending the last image or one of the shutter's blade while it is down, or send nothing. The first shows as frames that repeat
(sensor noise makes true images of even a static scene differ), the second as frames without anything in them, the third as a gap in stamps that
otherwise come evenly. Afterwards level and fixed pattern are others, which shows a closure between two frames. A camera may also say it itself.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from thegra_core.config import ShutterConfig
from thegra_core.messages import Frame, ImageArray, Shutter, ShutterState
from thegra_core.preprocessing.sensor import SensorLook, SensorWatch

_GRID = 8
_MAX_DIFFERENT = 0.001
"""Share of pixels that may differ in a frozen image: an overlay, a flickering pixel."""
_HISTORY = 32
_MIN_PERIODS = 8
_USUAL_WITHIN = 90
_USUAL_RUNS = 3


class ShutterDetector:
    """Tells of each frame whether the camera can see.

    CLOSED is a frame that repeats the one before it, up to a constant and at most 0.1 % of the pixels, one whose pixels are all equal, one that suddenly
    shows nothing but noise, and one of which the camera says so. The frame before the first repeat was seen and stays OPEN. The first other frame is
    JUST_OPENED, as is a frame after a gap of more than `gap_periods` median periods in an even stream. Streams whose stamps are whole seconds or uneven
    (photo flights) have no gaps. A camera that stands still is told from a closed shutter by its noise, which goes on.

    A frame that the sensor meets with another level or fixed pattern than the frame before is `recalibrated`, and JUST_OPENED in an even stream; in a
    photo flight the shutter closed while nobody looked.

    Streams padded to a higher rate repeat frames all the time: once three runs of repeats have ended within 90 frames, runs at most one longer than their
    median are OPEN. A static scene in 8-bit video can repeat exactly for long; it is called CLOSED, which costs nothing: there is nothing new to see.
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
        self._sensor = SensorWatch()

    def update(self, frame: Frame) -> ShutterState:
        """State at `frame`. Frames whose stamp is not after the last one's say nothing and keep the state."""
        previous = self._previous
        if not self._config.enabled or (previous is not None and frame.stamp_ns <= previous.stamp_ns):
            return ShutterState(frame.stamp_ns, self._state)
        self._count += 1
        self._previous = frame
        look = SensorLook.at(frame.image)
        blind, repeats = self._why_blind(frame, previous, look)
        state = self._blind(frame, blind, repeats) if blind else self._seeing(frame, previous, look)
        if previous is not None:
            self._periods.append(frame.stamp_ns - previous.stamp_ns)
        self._whole_seconds &= frame.stamp_ns % 1_000_000_000 == 0
        if not blind or previous is None:
            self._last_seen_ns = frame.stamp_ns
        self._state = Shutter.CLOSED if state.shutter is Shutter.CLOSED else Shutter.OPEN
        return state

    def _why_blind(self, frame: Frame, previous: Frame | None, look: SensorLook) -> tuple[str, bool]:
        """Why nothing new can be seen, or an empty string; and whether the image merely repeats."""
        if frame.shutter_closed:
            return "the camera says so", False
        if previous is not None and _same(frame.image, previous.image):
            return "the image repeats", True
        if _blank(frame.image):
            return "all pixels are equal", False
        if self._sensor.is_flat(look) and not self._long_blind(frame):
            return "the image shows nothing but noise", False
        return "", False

    def _blind(self, frame: Frame, reason: str, repeats: bool) -> ShutterState:
        self._repeats += 1
        if repeats and self._state is not Shutter.CLOSED and self._repeats <= self._usual_run():
            return ShutterState(frame.stamp_ns, Shutter.OPEN, "repeated frame, usual in this stream")
        return ShutterState(frame.stamp_ns, Shutter.CLOSED, reason)

    def _seeing(self, frame: Frame, previous: Frame | None, look: SensorLook) -> ShutterState:
        run, self._repeats = self._repeats, 0
        if run:
            self._runs.append((self._count, run))
        reason = ""
        if self._state is Shutter.CLOSED:
            reason = f"first new image after {(frame.stamp_ns - self._last_seen_ns) * 1e-9:.2f} s, {run} frames"
        elif previous is not None and self._is_gap(frame.stamp_ns - previous.stamp_ns):
            reason = f"gap of {(frame.stamp_ns - previous.stamp_ns) * 1e-9:.2f} s"
        if reason:
            self._sensor.forget()
        change = self._sensor.update(look)
        state = Shutter.JUST_OPENED if reason or (change and self._is_even()) else Shutter.OPEN
        return ShutterState(frame.stamp_ns, state, reason or change, bool(reason or change))

    def _long_blind(self, frame: Frame) -> bool:
        """Whether it has lasted longer than a closure can: then what shows nothing but noise is a bare wall."""
        return self._state is Shutter.CLOSED and frame.stamp_ns - self._last_seen_ns > self._config.longest_s * 1e9

    def _usual_run(self) -> int:
        while self._runs and self._runs[0][0] < self._count - _USUAL_WITHIN:
            self._runs.popleft()
        return int(np.median([length for _, length in self._runs])) + 1 if len(self._runs) >= _USUAL_RUNS else 0

    def _is_gap(self, gap_ns: int) -> bool:
        return self._is_even() and gap_ns > self._config.gap_periods * float(np.median(self._periods))

    def _is_even(self) -> bool:
        """Whether frames come at one period, as those of a video do."""
        if len(self._periods) < _MIN_PERIODS or self._whole_seconds:
            return False
        low, middle, high = np.percentile(np.fromiter(self._periods, np.float64), [10, 50, 90])
        return bool((high - low) / middle < self._config.max_jitter)


def _same(image: ImageArray, other: ImageArray) -> bool:
    if image.shape != other.shape or image.dtype != other.dtype:
        return False
    if not _mostly_shifted(image[::_GRID, ::_GRID], other[::_GRID, ::_GRID]):
        return False
    return _mostly_shifted(image, other)


def _mostly_shifted(image: ImageArray, other: ImageArray) -> bool:
    """Whether two images differ by a constant, but for a few pixels; that of integers may go round."""
    difference = image - other
    constant = np.median(difference[:: max(len(difference) // 8, 1)]).astype(image.dtype)
    return int(np.count_nonzero(difference != constant)) <= _MAX_DIFFERENT * image.size


def _blank(image: ImageArray) -> bool:
    grid = image[::_GRID, ::_GRID]
    return bool(grid.min() == grid.max() and image.min() == image.max())
