"""What is read and made ready while what came before is worked on."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")


def read_ahead(items: Iterator[Item], count: int) -> Iterator[Item]:
    """The same items, taken by a thread of its own, `count` of them before they are asked for; what it raises is raised in their place."""
    with ThreadPoolExecutor(1, "thegra reading") as reader:
        waiting = deque(reader.submit(next, items, None) for _ in range(count))
        while (item := waiting.popleft().result()) is not None:
            waiting.append(reader.submit(next, items, None))
            yield item
