"""A handful of frames spread evenly over a run of unknown length."""

from __future__ import annotations

from collections.abc import Callable

from thegra_core.messages import Snapshot

MOST = 8


class SnapshotKeeper:
    """Keeps every n-th frame offered; when there are too many, every second is dropped and n doubles."""

    def __init__(self) -> None:
        self._kept: list[Snapshot] = []
        self._stride = 1
        self._offered = 0

    def offer(self, _index: int, make: Callable[[], Snapshot]) -> None:
        """Keep the frame if its turn has come; `make` is only called then."""
        if self._offered % self._stride == 0:
            self._kept.append(make())
            if len(self._kept) > 2 * MOST:
                self._kept = self._kept[::2]
                self._stride *= 2
        self._offered += 1

    def kept(self) -> tuple[Snapshot, ...]:
        """At most `MOST` snapshots in order of time."""
        stride = max(1, -(-len(self._kept) // MOST))
        return tuple(self._kept[::stride])
