"""The thread that hands frames to the engine and results on, and begins anew when the engine fails."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from thegra_core.errors import ThegraError
from thegra_ros.engine import Done, Engine, EngineError, Job, Order
from thegra_ros.frame_queue import LatestQueue

MOST_FAILURES = 3
"""In a row; then the engine is given up."""
LAST_S = 1.0
"""How long the work on a frame may go on when the process ends."""
T = TypeVar("T")


class NotWorkingError(ThegraError):
    """An order came when nothing works any more."""

    def __init__(self) -> None:
        super().__init__("the SLAM system does not work: /diagnostics and the log say why")


@dataclass(frozen=True, slots=True)
class _Asked:
    """An order that waits; `then` is called from the thread when it was obeyed, before anything else is worked on."""

    order: Order
    then: Callable[[], None]
    answer: Future[str] = field(default_factory=Future)


class Worker(Generic[T]):
    """Takes items from a bounded queue; `to_job` makes a job of one when its turn comes, or None of one that nobody wants any more.

    `on_done` gets item, result and milliseconds; `on_failure` a text, and whether that is the end; `on_refused` an item whose epoch cannot be begun, and what
    the user has to put right: the other items of that epoch are passed over. All are called from the thread. `is_alive` is False once the process is told to
    end: then failures are no news.
    """

    def __init__(
        self, make_engine: Callable[[], Engine], queue_size: int, to_job: Callable[[T], Job | None], on_done: Callable[[T, Done, float], None],
        on_failure: Callable[[str, bool], None], on_refused: Callable[[T, str], None], is_alive: Callable[[], bool] = lambda: True,
    ) -> None:  # fmt: skip
        self._make_engine, self._to_job, self._is_alive = make_engine, to_job, is_alive
        self._on_done, self._on_failure, self._on_refused = on_done, on_failure, on_refused
        self.queue: LatestQueue[T | _Asked] = LatestQueue(queue_size)
        self._engine: Engine | None = None
        self._stopping = self._given_up = False
        self._refused_epoch: int | None = None
        self._thread = threading.Thread(target=self._run, name="thegra worker", daemon=True)

    def start(self) -> None:
        """Load the networks and begin to work, without waiting for either."""
        self._thread.start()

    def ask(self, order: Order, then: Callable[[], None] = lambda: None) -> Future[str]:
        """Have an order obeyed after the frame in work; the answer, or the ThegraError or EngineError that it ended with."""
        asked = _Asked(order, then)
        if not self.queue.put_first(asked):
            _refuse(asked)
        return asked.answer

    @property
    def given_up(self) -> bool:
        """Whether nothing is worked on any more; `on_failure` has said why."""
        return self._given_up

    def stop(self) -> None:
        """End, giving up the frame in work; waits until it has ended, but not for long where the process is told to end."""
        self._stopping = True
        self._close()
        if self._engine is not None:
            self._engine.stop()
        if self._thread.ident is not None:
            self._thread.join(None if self._is_alive() else LAST_S)

    def _close(self) -> None:
        for asked in self.queue.close():
            if isinstance(asked, _Asked):
                _refuse(asked)

    def _run(self) -> None:
        failures = 0
        while failures < MOST_FAILURES and not self._stopping:
            try:
                self._work()
                return
            except ThegraError as error:  # something the user has to put right first
                self._fail(str(error), True)
                break
            except Exception as error:  # a thread that ends without a word would be a node that does nothing
                if self._stopping or not self._is_alive():
                    break
                failures = failures + 1 if self._engine_worked == 0 else 1
                self._fail(str(error) if isinstance(error, EngineError) else traceback.format_exc(), failures == MOST_FAILURES)
            finally:
                if self._engine is not None:
                    self._engine.stop()
        self._close()

    def _fail(self, text: str, final: bool) -> None:
        self._given_up = final
        self._on_failure(text, final)

    def _work(self) -> None:
        self._engine_worked = 0
        self._engine = self._make_engine()
        if self._stopping:  # it may have looked for an engine before there was one
            return
        self._engine.start()
        while (item := self.queue.get()) is not None:
            if isinstance(item, _Asked):
                self._obey(self._engine, item)
                continue
            job = self._to_job(item)
            if job is None or job.epoch == self._refused_epoch:
                continue
            begin = time.monotonic()
            try:
                done = self._engine.process(job)
            except ThegraError as error:
                self._refused_epoch = job.epoch
                self._on_refused(item, str(error))
                continue
            self._engine_worked += 1
            self._on_done(item, done, 1e3 * (time.monotonic() - begin))

    @staticmethod
    def _obey(engine: Engine, asked: _Asked) -> None:
        try:
            answer = engine.obey(asked.order)
            asked.then()
        except ThegraError as error:
            asked.answer.set_exception(error)
        except Exception as error:
            asked.answer.set_exception(error)
            raise
        else:
            asked.answer.set_result(answer)


def _refuse(asked: _Asked) -> None:
    asked.answer.set_exception(NotWorkingError())
