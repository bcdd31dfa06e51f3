"""Mapping beside tracking for recordings: it works while tracking goes on, and yet every run of a recording gives the same bytes."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from thegra_core.map.map import Map
from thegra_core.mapping.process import MappingProcess
from thegra_core.messages import InitialMap, Keyframe, MapUpdate
from thegra_core.process import Usage, call_now

ANSWERED_AFTER = 2
"""Calls of `updates` after a keyframe at which all that comes of it is given. `Slam` calls it before and after each frame is tracked: mapping works while the
next frame is read, filtered and followed, and tracking has the adjusted map then. In quick motion, where nearly every frame is a keyframe, what comes later
comes too late (measured: four frames later the error of a room is 1.2 m instead of 0.06, two frames later 0.1)."""


class LockstepMapping:
    """`MappingService` that takes answers at fixed times, counted in calls of `updates`, and waits for those that are not there by then.

    One keyframe at a time: the next one waits until all is done about the one before.
    """

    def __init__(self, beside: MappingProcess) -> None:
        self._beside = beside
        self._updates: list[MapUpdate] = []
        self._calls = ANSWERED_AFTER

    def initialize(self, initial: InitialMap) -> None:
        """See `MappingService.initialize`; the map is there when it returns."""
        self._collect()
        self._beside.initialize(initial)
        self._collect()

    def insert(self, keyframe: Keyframe) -> None:
        """See `MappingService.insert`."""
        self._collect()
        self._beside.insert(keyframe)
        self._calls = 0

    def drop(self, map_id: int) -> None:
        """See `MappingService.drop`."""
        self._collect()
        self._beside.drop(map_id)

    def updates(self) -> list[MapUpdate]:
        """The updates whose time has come, in order.

        Raises:
            MappingError: If mapping has ended with an error.
        """
        self._calls += 1
        if self._calls == ANSWERED_AFTER:
            self._collect()
        taken, self._updates = self._updates, []
        return taken

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """See `MappingService.submit`; at once, as there is no map to work on meanwhile."""
        return call_now(function, *arguments)

    def load(self, path: Path) -> MapUpdate:
        """See `MappingService.load`."""
        return self._beside.load(path)

    def save(self, path: Path) -> None:
        """See `MappingService.save`."""
        self._beside.save(path)

    def finish(self) -> list[MapUpdate]:
        """See `MappingService.finish`."""
        self._collect()
        return [*self.updates(), *self._beside.finish()]

    def maps(self) -> list[Map]:
        """See `MappingService.maps`."""
        return self._beside.maps()

    def counts(self) -> tuple[int, int]:
        """See `MappingService.counts`."""
        return self._beside.counts()

    def usage(self) -> Usage:
        """See `MappingService.usage`."""
        return self._beside.usage()

    def close(self) -> None:
        """See `MappingService.close`."""
        self._beside.close()

    def _collect(self) -> None:
        """Wait until all is done that was handed over, and keep what came of it."""
        self._updates += self._beside.last_updates()
