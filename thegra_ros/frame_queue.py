"""A bounded queue between the callback that receives images and the thread that works on them."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class LatestQueue(Generic[T]):
    """Holds the newest items: when it is full the oldest goes, and is counted. Any thread may put, one thread gets."""

    def __init__(self, size: int) -> None:
        self._items: deque[T] = deque()
        self._size = size
        self._changed = threading.Condition()
        self._closed = False
        self._dropped = 0

    def put(self, item: T) -> None:
        """Add an item; never waits."""
        with self._changed:
            if self._closed:
                return
            if len(self._items) >= self._size:
                self._items.popleft()
                self._dropped += 1
            self._items.append(item)
            self._changed.notify()

    def get(self) -> T | None:
        """The oldest item, waiting for one; None once the queue is closed."""
        with self._changed:
            while not self._items and not self._closed:
                self._changed.wait()
            return None if self._closed else self._items.popleft()

    def clear(self) -> None:
        """Forget what waits; it does not count as dropped."""
        with self._changed:
            self._items.clear()

    def close(self) -> None:
        """Let `get` return None from now on."""
        with self._changed:
            self._closed = True
            self._items.clear()
            self._changed.notify_all()

    def __len__(self) -> int:
        with self._changed:
            return len(self._items)

    @property
    def dropped(self) -> int:
        """Items that were pushed out by newer ones."""
        with self._changed:
            return self._dropped
