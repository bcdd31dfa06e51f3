"""Mapping that is behind tracking, without a process: what it does and answers comes in the order of `mapping.process`, counted in looks for updates."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

from thegra_core.mapping import process
from thegra_core.mapping.mapper import Mapper
from thegra_core.mapping.service import InlineMapping
from thegra_core.messages import InitialMap, Keyframe, MapUpdate

Looks = Callable[[str], int]
"""Looks for updates that pass before each answer to a message of that name."""


class LateMapping(InlineMapping):
    """Looks at its work when it is looked at; `looks` says for how long each answer is not there yet."""

    def __init__(self, mapper: Mapper, looks: Looks) -> None:
        super().__init__(mapper)
        self._looks = looks
        self._worker = InlineMapping(mapper)
        self._waiting: deque[tuple[str, tuple[Any, ...]]] = deque()
        self._answers: Iterator[tuple[str, Any]] | None = None
        self._ready: list[MapUpdate] = []
        self._asked: deque[Future[Any]] = deque()
        self._rest = 0

    def initialize(self, initial: InitialMap) -> None:
        self._waiting.append(("initialize", (initial,)))

    def insert(self, keyframe: Keyframe) -> None:
        self._waiting.append(("insert", (keyframe,)))

    def drop(self, map_id: int) -> None:
        self._waiting.append(("drop", (map_id,)))

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        self._asked.append(Future())
        self._waiting.append(("call", (function, *arguments)))
        return self._asked[-1]

    def updates(self, patience_s: float = 0.0) -> list[MapUpdate]:
        self._work()
        ready, self._ready = self._ready, []
        return ready

    def finish(self) -> list[MapUpdate]:
        while self._waiting or self._answers is not None:
            self._rest = 0
            self._work()
        return [*self._ready, *super().finish()]

    def _work(self) -> None:
        if self._answers is None and self._waiting:
            name, arguments = self._waiting.popleft()
            self._answers = process._do(self._worker, name, arguments, lambda: any(n in ("insert", "call") for n, _ in self._waiting))
            self._name, self._rest = name, self._looks(name)
        if self._answers is None or self._rest > 0:
            self._rest -= 1
            return
        answer = next(self._answers, None)
        if answer is None:
            self._answers = None
        elif answer[0] == "result":
            self._asked.popleft().set_result(answer[1])
        else:
            self._ready.extend(answer[1])
            self._rest = self._looks(self._name)
