"""Base of the nodes of single stages: parameters, diagnostics, and a thread that works on what the callbacks enqueue."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from thegra_core.errors import ThegraError
from thegra_core.process import keep_freed_memory, set_threads
from thegra_ros.answers import result_of
from thegra_ros.beside import EngineError
from thegra_ros.diagnostics import Health, Reporter
from thegra_ros.frame_queue import LatestQueue
from thegra_ros.lifecycle import ManagedNode
from thegra_ros.node_parameters import NodeParameters

LAST_S = 1.0
"""How long the work on a frame may go on when the process ends."""
EVERYTHING = 10**6
"""Size of a queue that drops nothing."""


T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class _Task(Generic[T]):
    """Something to do between two items."""

    do: Callable[[], T]
    answer: Future[T] = field(default_factory=Future)


class StageNode(ManagedNode):
    """Derived nodes override `prepare` (topics), `load` (networks, in the thread), `work` (one item, in the thread), `pushed_out` and `begin_anew`."""

    queue_size = 0  # 0: as the parameter says

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        keep_freed_memory()
        self.settings = NodeParameters(self)
        self.queue: LatestQueue[Any] | None = None
        self._thread: threading.Thread | None = None
        self.stopping = threading.Event()

    def prepare(self) -> None:
        """Make publishers and subscriptions."""

    def load(self) -> None:
        """Load what takes time; nothing is worked on before."""

    def work(self, item: Any) -> None:
        """Work on an item."""

    def pushed_out(self, item: Any) -> None:
        """An item went for a newer one and is not worked on; called by who enqueues."""

    def begin_anew(self, why: str) -> None:
        """Forget what was known of the stream."""

    def facts(self) -> dict[str, object]:
        """What the diagnostics say besides."""
        return {}

    def enqueue(self, item: Any) -> None:
        """Hand an item to the thread."""
        if self.active and self.queue is not None:
            gone = self.queue.put(item)
            if gone is not None:
                self.pushed_out(gone)

    async def ask(self, do: Callable[[], str]) -> str:
        """Have something done in the thread, before the items that wait; what it returned.

        Raises:
            Exception: What it raised.
        """
        return await result_of(self, self.do_first(do))

    def do_first(self, do: Callable[[], T]) -> Future[T]:
        """Have something done in the thread, before the items that wait, which is never dropped, also while the node is not active; what will come of it."""
        task = _Task(do)
        if self.queue is None or not self.queue.put_first(task):
            _refuse(task)
        return task.answer

    def tell(self, text: str) -> None:
        """Say what keeps the stage from working."""
        self.get_logger().error(text)
        self.health.trouble = text.strip().splitlines()[-1]
        self.reporter.report()

    def configure(self) -> None:
        self.config, self.own = self.settings.read()
        set_threads(self.config.threads)
        self.health = Health()
        self.reporter = Reporter(self, self.health, self._all_facts, self.own.diagnostics_period_s)
        self.queue = LatestQueue(self.queue_size or self.own.queue_size)
        self.stopping.clear()
        self.prepare()
        self._thread = threading.Thread(target=self._run, args=(self.queue,), name="thegra stage", daemon=True)
        self._thread.start()
        self.settings.configured = True

    def release(self) -> None:
        self.stopping.set()
        if self.queue is not None:
            _close(self.queue)
        if self._thread is not None:
            self._thread.join(None if self.context.ok() else LAST_S)  # a process that ends does not wait for networks to load
        self.queue = self._thread = None
        self.settings.configured = False

    def _all_facts(self) -> dict[str, object]:
        return {"dropped": self.queue.dropped if self.queue is not None else 0, **self.facts()}

    def _run(self, queue: LatestQueue[Any]) -> None:
        try:
            self.load()
            while (item := queue.get()) is not None:
                if isinstance(item, _Task):
                    _do(item)
                elif self.active and not self._worked_on(item):
                    return
        except Exception as error:  # a thread that ends without a word would be a node that does nothing
            if not self._ends:
                self.tell(_words(error))
        finally:
            _close(queue)

    def _worked_on(self, item: Any) -> bool:
        """Work on an item, whatever becomes of it; False when the node ends."""
        self.health.trouble = ""  # of the item before
        try:
            self.work(item)
            self.health.worked()
        except Exception as error:
            if self._ends:
                return False
            self.tell(_words(error))
            self.begin_anew("the stage failed")
        return True

    @property
    def _ends(self) -> bool:
        return self.stopping.is_set() or not self.context.ok()


def _words(error: Exception) -> str:
    return str(error) if isinstance(error, ThegraError | EngineError) else traceback.format_exc()


def _do(task: _Task[Any]) -> None:
    try:
        task.answer.set_result(task.do())
    except Exception as error:  # it is the asker's to tell
        task.answer.set_exception(error)


def _close(queue: LatestQueue[Any]) -> None:
    for item in queue.close():
        if isinstance(item, _Task):
            _refuse(item)


def _refuse(task: _Task[Any]) -> None:
    task.answer.set_exception(ThegraError("the stage does not work: /diagnostics and the log say why"))
