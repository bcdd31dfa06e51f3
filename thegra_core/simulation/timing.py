"""When frames are taken, stamped, lost, and blinded by the shutter."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, unique

import numpy as np
from numpy.typing import NDArray

from thegra_core.simulation.sensor_config import SensorConfig

IntArray = NDArray[np.int64]
_FIRST_CLOSURE = 0.45  # of a recording that is shorter than the time between corrections


@unique
class Fate(Enum):
    """What becomes of a frame."""

    SEEN = "seen"
    BLIND = "blind"
    DROPPED = "dropped"


@dataclass(frozen=True, slots=True)
class Schedule:
    """times_ns (N,) when frames are taken, from 0; stamps_ns (N,) as the camera tells it, from 0; fates; closures: (first blind, first seen again) frame."""

    times_ns: IntArray
    stamps_ns: IntArray
    fates: tuple[Fate, ...]
    closures: tuple[tuple[int, int], ...]


def make_schedule(times_ns: IntArray, config: SensorConfig, shutter: bool, seed: int) -> Schedule:
    """Plan frames taken at `times_ns` (N,), in order: which are lost or blind, and what their stamps say.

    Stamps stay in order however large the jitter. The first frame is never lost.
    """
    rng = np.random.default_rng([seed, 10])
    jitter = rng.standard_normal(len(times_ns)) * config.stamp_jitter_us * 1e3
    stamps = times_ns + np.rint(jitter).astype(np.int64)
    stamps = np.maximum.accumulate(stamps - np.arange(len(stamps))) + np.arange(len(stamps))  # no two alike
    closures = _closures(times_ns, config) if shutter else ()
    dropped = rng.random(len(times_ns)) < config.frame_drop
    dropped[:1] = False
    fates = [Fate.DROPPED if lost else Fate.SEEN for lost in dropped]
    for begin, end in closures:
        fates[begin:end] = [Fate.BLIND] * (end - begin)
    return Schedule(times_ns, stamps, tuple(fates), closures)


def _closures(times_ns: IntArray, config: SensorConfig) -> tuple[tuple[int, int], ...]:
    """Frames inside closures that both begin and end within the recording."""
    if len(times_ns) == 0:
        return ()
    seconds = (times_ns - times_ns[0]) * 1e-9
    begins = np.arange(config.closure_period_s, seconds[-1] - config.closure_s, config.closure_period_s)
    if len(begins) == 0:
        begins = np.array([_FIRST_CLOSURE * seconds[-1]])
    spans = [(int(np.searchsorted(seconds, begin - 1e-9)), int(np.searchsorted(seconds, begin + config.closure_s - 1e-9))) for begin in begins]
    return tuple((begin, end) for begin, end in spans if 0 < begin < end < len(times_ns))
