"""What a recording holds, found by reading it once."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import PreprocessingConfig
from thegra_core.messages import Shutter
from thegra_core.preprocessing.shutter import ShutterDetector
from thegra_core.sources.recording import Recording

GAP_PERIODS = 3.0
_SAMPLE_STEP = 16


@dataclass(frozen=True, slots=True)
class Summary:
    """Figures of a recording; times in seconds since its first frame unless named otherwise.

    sizes maps "WIDTHxHEIGHT dtype" to frames; period_s is the median step between stamps, jitter the spread of the steps (10 to 90 %) over it;
    gaps are (begin, length) of steps over three periods; repeated counts frames identical to the one before; quantiles are those of the raw
    values at 1, 50 and 99 %; closures are (begin, end) of what looks like a closed shutter.
    """

    frames: int
    sizes: dict[str, int] = field(default_factory=dict)
    first_stamp_ns: int | None = None
    duration_s: float = 0.0
    period_s: float | None = None
    jitter: float | None = None
    gaps: tuple[tuple[float, float], ...] = ()
    stamps_not_increasing: int = 0
    repeated: int = 0
    quantiles: tuple[float, float, float] | None = None
    closures: tuple[tuple[float, float], ...] = ()


def summarize(recording: Recording) -> Summary:
    """Read every frame of a recording and measure it; unreadable frames are in `recording.problems` afterwards."""
    detector = ShutterDetector(PreprocessingConfig().shutter)
    stamps: list[int] = []
    states: list[Shutter] = []
    sizes: Counter[str] = Counter()
    samples: list[NDArray[np.float32]] = []
    repeated = 0
    previous = None
    for frame in recording.frames():
        image = frame.image
        stamps.append(frame.stamp_ns)
        states.append(detector.update(frame).shutter)
        sizes[f"{image.shape[1]}x{image.shape[0]} {image.dtype}"] += 1
        samples.append(image[::_SAMPLE_STEP, ::_SAMPLE_STEP].astype(np.float32).ravel())
        repeated += previous is not None and np.array_equal(image, previous)
        previous = image
    if not stamps:
        return Summary(0)
    times = np.array(stamps, np.int64) - stamps[0]
    low, middle, high = np.percentile(np.concatenate(samples), [1, 50, 99])
    steps = np.diff(times)
    period, jitter, gaps = _pace(times, steps)
    return Summary(
        frames=len(stamps), sizes=dict(sizes), first_stamp_ns=stamps[0], duration_s=float(np.ptp(times)) * 1e-9, period_s=period, jitter=jitter,
        gaps=gaps, stamps_not_increasing=int(np.count_nonzero(steps <= 0)), repeated=repeated,
        quantiles=(float(low), float(middle), float(high)), closures=_closures(times, states),
    )  # fmt: skip


def _pace(times: NDArray[np.int64], steps: NDArray[np.int64]) -> tuple[float | None, float | None, tuple[tuple[float, float], ...]]:
    forward = steps[steps > 0]
    if not len(forward):
        return None, None, ()
    low, period, high = np.percentile(forward, [10, 50, 90])
    gaps = np.flatnonzero(steps > GAP_PERIODS * period)
    return float(period) * 1e-9, float((high - low) / period), tuple((float(times[i]) * 1e-9, float(steps[i]) * 1e-9) for i in gaps)


def _closures(times: NDArray[np.int64], states: list[Shutter]) -> tuple[tuple[float, float], ...]:
    """Closed spans: from the first closed frame, or the last frame before a gap, to the first frame after."""
    spans: list[tuple[float, float]] = []
    begin: int | None = None
    for i, state in enumerate(states):
        if state is Shutter.CLOSED and begin is None:
            begin = i
        elif state is Shutter.JUST_OPENED or (begin is not None and state is Shutter.OPEN):
            spans.append((float(times[begin if begin is not None else max(i - 1, 0)]) * 1e-9, float(times[i]) * 1e-9))
            begin = None
    if begin is not None:
        spans.append((float(times[begin]) * 1e-9, float(times[-1]) * 1e-9))
    return tuple(spans)
