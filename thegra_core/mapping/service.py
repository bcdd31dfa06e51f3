"""Mapping as tracking's partner sees it: keyframes go in, updates come out, at once or when they are ready."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Protocol

from thegra_core.map.map import Map
from thegra_core.mapping.mapper import Mapper
from thegra_core.messages import InitialMap, Keyframe, MapUpdate
from thegra_core.process import Usage, call_now

MOST_LEFT = 1
"""Keyframes in a row that are left before all is done because others wait; fewer than the keyframes that a local adjustment takes in."""


class MappingService(Protocol):
    """Takes what tracking hands over without making it wait; `updates` has what came of it.

    All other calls wait for the work handed over before.
    """

    def initialize(self, initial: InitialMap) -> None:
        """See `Mapper.initialize`."""
        ...

    def insert(self, keyframe: Keyframe) -> None:
        """See `Mapper.insert`; a keyframe of a map that is no more, for it was merged meanwhile, is let go."""
        ...

    def drop(self, map_id: int) -> None:
        """See `Mapper.drop`."""
        ...

    def updates(self, patience_s: float = 0.0) -> list[MapUpdate]:
        """The updates that have come since the last call, in order; where there are none the next message is waited for, but no longer than `patience_s`.

        Raises:
            MappingError: If mapping has ended with an error.
        """
        ...

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Have a function of a module called where mapping runs, after what was handed over before; done when an `updates` after it finds it so."""
        ...

    def load(self, path: Path) -> MapUpdate:
        """See `Mapper.load`."""
        ...

    def save(self, path: Path) -> None:
        """Write the map with most keyframes.

        Raises:
            InputError: If there is no map, or the file cannot be written.
        """
        ...

    def finish(self) -> list[MapUpdate]:
        """Full bundle adjustment of each map; also the updates that were still to come, in order."""
        ...

    def maps(self) -> list[Map]:
        """All maps as they are, by id; the caller reads them and changes nothing."""
        ...

    def counts(self) -> tuple[int, int]:
        """Loops closed and maps merged."""
        ...

    def usage(self) -> Usage:
        """What mapping has used beside the calling process."""
        ...

    def close(self) -> None:
        """End; what was handed over may be left undone."""
        ...


class InlineMapping:
    """`MappingService` in the calling thread: the update is there when the call returns."""

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._updates: list[MapUpdate] = []
        self._left = 0

    def initialize(self, initial: InitialMap) -> None:
        """See `MappingService.initialize`."""
        self._updates.append(self._mapper.initialize(initial))

    def insert(self, keyframe: Keyframe) -> None:
        """See `MappingService.insert`."""
        if keyframe.map_id in self._mapper.map_ids:
            self._updates.append(self._mapper.insert(keyframe))

    def insert_by_steps(self, keyframe: Keyframe, others_wait: Callable[[], bool]) -> Iterator[MapUpdate]:
        """As `insert`, with an update after each step: the new landmarks first, for a tracker that goes on meanwhile.

        Where others wait the rest is left out: the next keyframe needs landmarks more than this one needs accuracy, and is adjusted with it. After `MOST_LEFT`
        keyframes in a row everything is done all the same.
        """
        if keyframe.map_id not in self._mapper.map_ids:
            return
        self._left += 1

        def is_left() -> bool:
            return self._left <= MOST_LEFT and others_wait()

        yield from self._mapper.grow(keyframe, is_left)
        if is_left():
            return
        yield self._mapper.settle(keyframe)
        if is_left():
            return
        self._left = 0
        tied = self._mapper.tie(keyframe)
        if tied is not None:
            yield tied

    def drop(self, map_id: int) -> None:
        """See `MappingService.drop`."""
        self._mapper.drop(map_id)

    def updates(self, patience_s: float = 0.0) -> list[MapUpdate]:
        """See `MappingService.updates`; here nothing is under way."""
        taken, self._updates = self._updates, []
        return taken

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """See `MappingService.submit`."""
        return call_now(function, *arguments)

    def load(self, path: Path) -> MapUpdate:
        """See `MappingService.load`."""
        return self._mapper.load(path)

    def save(self, path: Path) -> None:
        """See `MappingService.save`."""
        self._mapper.save_largest(path)

    def finish(self) -> list[MapUpdate]:
        """See `MappingService.finish`."""
        return [*self.updates(), *(self._mapper.finish(map_id) for map_id in self._mapper.map_ids)]

    def maps(self) -> list[Map]:
        """See `MappingService.maps`."""
        return [self._mapper.map(map_id) for map_id in self._mapper.map_ids]

    def counts(self) -> tuple[int, int]:
        """See `MappingService.counts`."""
        return self._mapper.loops, self._mapper.merges

    def usage(self) -> Usage:
        """See `MappingService.usage`: nothing."""
        return Usage()

    def close(self) -> None:
        """See `MappingService.close`."""
