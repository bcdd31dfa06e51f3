"""Which landmarks frames should have seen, and which they have, since mapping was told last."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thegra_core.messages import VisibilityCounts

IntArray = NDArray[np.int64]
MOST_FRAMES = 64
"""Frames that are kept one by one; a camera that stands still makes no keyframe, and its frames see the same landmarks for hours."""


class VisibilityTally:
    """Counts landmarks over frames, in memory that grows with the landmarks only."""

    def __init__(self) -> None:
        self._ids = self._visible = self._found = np.empty(0, np.int64)
        self._frames: list[tuple[IntArray, IntArray]] = []

    def note(self, visible: IntArray, found: IntArray) -> None:
        """One frame: ids (V,) of the landmarks that it should see, and those (F,) of them that it sees."""
        self._frames.append((visible, found))
        if len(self._frames) == MOST_FRAMES:
            self._fold()

    def take(self) -> VisibilityCounts:
        """The counts, and begin anew."""
        self._fold()
        counts = VisibilityCounts(self._ids, self._visible, self._found)
        self.forget()
        return counts

    def forget(self) -> None:
        """Begin anew."""
        self._ids = self._visible = self._found = np.empty(0, np.int64)
        self._frames = []

    def _fold(self) -> None:
        visible, found = (np.concatenate([np.empty(0, np.int64), *(frame[i] for frame in self._frames)]) for i in (0, 1))
        ids = np.union1d(self._ids, visible)
        known = np.searchsorted(ids, self._ids)
        counts = np.stack([np.bincount(np.searchsorted(ids, seen), minlength=len(ids)) for seen in (visible, found)]).astype(np.int64)
        counts[:, known] += np.stack([self._visible, self._found])
        self._ids, (self._visible, self._found), self._frames = ids, counts, []
