"""Tells a stream that loses images on its way from one that is slow or pauses."""

from __future__ import annotations

import numpy as np

SPAN = 60
_SHORT_STEP_PCT = 20


class GapWatch:
    """Looks at every stamp once; tells now and then what share of an even stream is missing.

    The period is a short step between the stamps: where many images are missing the usual step is a multiple of it.
    """

    def __init__(self) -> None:
        self._stamps: list[int] = []

    def missing(self, stamp_ns: int) -> float | None:
        """The share of images missing among the last `SPAN`, once there are so many; then it begins anew. Time that goes back does, too."""
        if self._stamps and stamp_ns <= self._stamps[-1]:
            self._stamps = []
        self._stamps.append(stamp_ns)
        if len(self._stamps) < SPAN:
            return None
        steps = np.diff(self._stamps)
        self._stamps = []
        return float(max(0.0, 1.0 - len(steps) * np.percentile(steps, _SHORT_STEP_PCT) / steps.sum()))
