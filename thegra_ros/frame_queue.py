"""A bounded queue between the callback that receives images and the thread that works on them."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class LatestQueue(Generic[T]):
    """Holds the newest items: when it is full the oldest goes, and is counted. Any thread may put, one thread gets.

    What is put with `put_first` comes before all of them, is never dropped, and does not count for the size.
    """

    def __init__(self, size: int) -> None:
        self._items: deque[T] = deque()
        self._urgent: deque[T] = deque()
        self._size = size
        self._changed = threading.Condition()
        self._closed = False
        self._dropped = 0

    def put(self, item: T) -> T | None:
        """Add an item; never waits. The one that it pushed out, if any."""
        with self._changed:
            if self._closed:
                return None
            pushed_out = None
            if len(self._items) >= self._size:
                pushed_out = self._items.popleft()
                self._dropped += 1
            self._items.append(item)
            self._changed.notify()
            return pushed_out

    def put_first(self, item: T) -> bool:
        """Add an item that must not be lost; False once the queue is closed."""
        with self._changed:
            if not self._closed:
                self._urgent.append(item)
                self._changed.notify()
            return not self._closed

    def get(self) -> T | None:
        """The next item, waiting for one; None once the queue is closed."""
        with self._changed:
            while not self._items and not self._urgent and not self._closed:
                self._changed.wait()
            if self._closed:
                return None
            return self._urgent.popleft() if self._urgent else self._items.popleft()

    def clear(self) -> None:
        """Forget the items that wait and may be dropped; they do not count as dropped."""
        with self._changed:
            self._items.clear()

    def close(self) -> list[T]:
        """Let `get` return None from now on; what was put first and is left."""
        with self._changed:
            self._closed = True
            self._items.clear()
            left = list(self._urgent)
            self._urgent.clear()
            self._changed.notify_all()
            return left

    def __len__(self) -> int:
        with self._changed:
            return len(self._items)

    @property
    def dropped(self) -> int:
        """Items that were pushed out by newer ones."""
        with self._changed:
            return self._dropped
