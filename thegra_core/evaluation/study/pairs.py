"""Pairs of frames a fixed time apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thegra_core.messages import IntArray


def pairs_at_interval(stamps_ns: Sequence[int], interval_s: float, most: int) -> list[tuple[int, int]]:
    """Indices (earlier, later) of frames whose stamps differ by `interval_s`, to half a frame period, evenly spread over the recording.

    Where frames are further apart than the interval (photo flights), neighbours are taken. Each frame begins at most one pair.
    """
    stamps: IntArray = np.asarray(stamps_ns, dtype=np.int64)
    if len(stamps) < 2:
        return []
    period = float(np.median(np.diff(stamps)))
    wanted = max(interval_s * 1e9, period)
    later = np.clip(np.searchsorted(stamps, stamps + wanted), 1, len(stamps) - 1)
    nearer = np.abs(stamps[later - 1] - stamps - wanted) < np.abs(stamps[later] - stamps - wanted)
    later = later - nearer
    error = np.abs(stamps[later] - stamps - wanted)
    begin = np.flatnonzero((later > np.arange(len(stamps))) & (error <= 0.5 * period))
    if len(begin) > most:
        begin = begin[np.unique(np.linspace(0, len(begin) - 1, most).round().astype(int))]
    return [(int(i), int(later[i])) for i in begin]
