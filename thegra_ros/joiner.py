"""Brings together what different topics say of one frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

MOST_PENDING = 200
"""Frames with some of their parts; the oldest goes when there are more, as when nothing announces them."""


class FrameJoiner:
    """Frames come out in the order in which `first` announces them, each once `complete` says that its parts are there.

    A frame that is still incomplete when a later one, announced to have as many parts, is complete has lost a part on the way: it is left out, and counted.
    """

    def __init__(self, first: str, complete: Callable[[Mapping[str, Any]], bool], stands_alone: Callable[[Mapping[str, Any]], bool]) -> None:
        self._first, self._complete, self._stands_alone = first, complete, stands_alone
        self._pending: dict[int, dict[str, Any]] = {}
        self.lost = 0

    def add(self, part: str, stamp_ns: int, value: Any) -> list[dict[str, Any]]:
        """Add a part of a frame; the frames that this completes."""
        if part == self._first:  # keeps the order of announcement, also where another part came sooner
            self._pending[stamp_ns] = {**self._pending.pop(stamp_ns, {}), part: value}
        else:
            self._pending.setdefault(stamp_ns, {})[part] = value
        if len(self._pending) > MOST_PENDING:
            del self._pending[next(iter(self._pending))]
            self.lost += 1
        announced = [stamp for stamp, parts in self._pending.items() if self._first in parts]
        last = max((i for i, s in enumerate(announced) if self._complete(self._pending[s]) and not self._stands_alone(self._pending[s])), default=-1)
        ready: list[dict[str, Any]] = []
        for position, stamp in enumerate(announced):
            if self._complete(self._pending[stamp]):
                ready.append(self._pending.pop(stamp))
            elif position < last:
                del self._pending[stamp]
                self.lost += 1
            else:
                break
        return ready

    def clear(self) -> None:
        """Forget what waits."""
        self._pending.clear()
