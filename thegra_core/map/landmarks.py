"""Landmarks as a structure of growing arrays, addressed by stable ids."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thegra_core.messages import LandmarkArrays

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

COLUMNS = ("ids", "points_world", "normals", "depth_min", "depth_max", "descriptors", "scores")
_COMPACT_AT = 1024


class LandmarkStore:
    """All landmarks of one map; ids only ever grow, so `ids` stays sorted and a look-up is a binary search.

    Removed rows stay until they outnumber the living, so that removal costs nothing that grows with the map.
    """

    def __init__(self) -> None:
        self._arrays: dict[str, NDArray[Any]] = {}
        self._alive: BoolArray = np.zeros(0, dtype=bool)
        self._rows = 0
        self._dead = 0

    def __len__(self) -> int:
        return self._rows - self._dead

    def column(self, name: str) -> NDArray[Any]:
        """View of one column over all rows, dead ones too; index it with `rows`."""
        return self._arrays[name][: self._rows] if self._arrays else np.empty(0)

    @property
    def points_world(self) -> NDArray[np.float64]:
        return self.column("points_world") if self._arrays else np.empty((0, 3))

    def rows(self, ids: IntArray) -> IntArray:
        """Row (N,) of each id (N,), -1 where the id is unknown, removed or negative."""
        if self._rows == 0 or len(ids) == 0:
            return np.full(len(ids), -1, dtype=np.int64)
        known = self._arrays["ids"][: self._rows]
        rows = np.minimum(np.searchsorted(known, ids), self._rows - 1)
        found = (known[rows] == ids) & self._alive[rows]
        return np.where(found, rows, -1)

    def alive_ids(self) -> IntArray:
        """Ids of all living landmarks, ascending."""
        return self.column("ids")[self._alive[: self._rows]].astype(np.int64) if self._rows else np.empty(0, np.int64)

    def get(self, ids: IntArray) -> LandmarkArrays:
        """Copies of the landmarks named.

        Raises:
            KeyError: If one of them is not alive.
        """
        rows = self.rows(ids)
        if np.any(rows < 0):
            raise KeyError(f"no landmarks {ids[rows < 0].tolist()}")
        return LandmarkArrays(**{name: self.column(name)[rows] for name in COLUMNS})

    def put(self, landmarks: LandmarkArrays) -> None:
        """Overwrite known landmarks, append new ones; new ids must exceed all earlier ones."""
        if len(landmarks) == 0:
            return
        rows = self.rows(landmarks.ids)
        known = rows >= 0
        new = np.flatnonzero(~known)
        new = new[np.argsort(landmarks.ids[new])]
        self._reserve(len(new), landmarks)
        for name in COLUMNS:
            values = getattr(landmarks, name)
            self._arrays[name][rows[known]] = values[known]
            self._arrays[name][self._rows : self._rows + len(new)] = values[new]
        self._alive[self._rows : self._rows + len(new)] = True
        self._rows += len(new)

    def remove(self, ids: IntArray) -> None:
        """Forget landmarks; unknown ids are ignored."""
        rows = self.rows(ids)
        rows = np.unique(rows[rows >= 0])
        self._alive[rows] = False
        self._dead += len(rows)
        if self._dead > max(_COMPACT_AT, self._rows // 2):
            keep = np.flatnonzero(self._alive[: self._rows])
            for name in COLUMNS:
                self._arrays[name] = self._arrays[name][keep].copy()
            self._alive = np.ones(len(keep), dtype=bool)
            self._rows, self._dead = len(keep), 0

    def _reserve(self, extra: int, like: LandmarkArrays) -> None:
        capacity = len(self._alive)
        if self._rows + extra <= capacity and self._arrays:
            return
        capacity = max(1024, 2 * capacity, self._rows + extra)
        for name in COLUMNS:
            template = getattr(like, name)
            grown = np.zeros((capacity, *template.shape[1:]), dtype=template.dtype)
            if self._rows:
                grown[: self._rows] = self._arrays[name][: self._rows]
            self._arrays[name] = grown
        alive = np.zeros(capacity, dtype=bool)
        alive[: self._rows] = self._alive[: self._rows]
        self._alive = alive
