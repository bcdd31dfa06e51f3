"""What stands for a node where its parts are tested without a graph: it keeps what they publish, and tells them what they listen to."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any


class StubNode:
    """An active node. remapped: other names of topics; sent: what was published, by topic."""

    active = True

    def __init__(self, **remapped: str) -> None:
        self._remapped = remapped
        self.sent: defaultdict[str, list[Any]] = defaultdict(list)
        self._listeners: dict[str, Callable[[Any], None]] = {}
        self._timers: list[Callable[[], None]] = []

    def tell(self, topic: str, message: Any) -> None:
        """A message comes in."""
        self._listeners[topic](message)

    def let_time_pass(self) -> None:
        """Every timer fires once."""
        for fire in self._timers:
            fire()

    def resolve_topic_name(self, name: str) -> str:
        return self._remapped.get(name, f"/{name}")

    def publisher(self, kind: type, topic: str, qos: object) -> SimpleNamespace:
        return SimpleNamespace(publish=self.sent[topic].append)

    def listen(self, kind: type, topic: str, qos: object, callback: Callable[[Any], None]) -> None:
        self._listeners[topic] = callback

    def every(self, period_s: float, callback: Callable[[], None]) -> None:
        self._timers.append(callback)

    def get_logger(self) -> logging.Logger:
        return logging.getLogger("stub")
