"""An object in a process of its own: its methods are called by name over a pipe, one at a time.

Bundle adjustment holds Python's global lock while it solves; in a node's process it would starve the callbacks that receive messages, and keep the node from
ending when it is told to.
"""

from __future__ import annotations

import logging
import multiprocessing
import signal
import threading
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from typing import Any, Protocol

from thegra_core.errors import ThegraError
from thegra_core.lifeline import end_with_parent
from thegra_core.process import keep_freed_memory

_log = logging.getLogger(__name__)
LAST_WORDS_S = 1.0
"""How long the process may take to end by itself when it is told to."""


class EngineError(Exception):
    """What works for a node has failed, or its process has ended."""


class Stoppable(Protocol):
    """What can be in a process of its own."""

    def stop(self) -> None:
        """The last call: end what it has started."""


class Beside:
    """`make(*arguments)` in a process of its own, which ends with this one, however this one ends."""

    def __init__(self, name: str, make: Callable[..., Stoppable], *arguments: Any, context: SpawnContext | None = None) -> None:
        context = context or multiprocessing.get_context("spawn")
        self._name = name
        self._connection, self._theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(name, self._theirs, make, arguments), daemon=True, name=name)
        self._sending, self._starting, self._stopped = threading.Lock(), threading.Lock(), False

    def start(self) -> None:
        """Start the process.

        Raises:
            EngineError: If `stop` was called before.
        """
        with self._starting:
            if self._stopped:
                raise EngineError(f"{self._name} was stopped before it began")
            self._process.start()
        self._theirs.close()

    def call(self, method: str, *arguments: Any) -> Any:
        """Call a method and wait for what it returns.

        Raises:
            ThegraError, EngineError: What it raised, or that it ended; any other exception comes as an EngineError with its traceback.
        """
        try:
            with self._sending:
                self._connection.send((method, arguments))
            answer = self._connection.recv()
        except (EOFError, OSError) as error:
            raise EngineError(self._epitaph()) from error
        if isinstance(answer, EngineError | ThegraError):
            raise answer
        return answer

    def stop(self) -> None:
        """End the process soon; a call in work is given up. May be called from any thread, and again."""
        with self._starting:
            self._stopped = True
        if self._process.pid is None:
            return
        try:
            with self._sending:
                self._connection.send(None)
        except (OSError, ValueError):  # it has gone already
            _log.debug("%s has gone already", self._name)
        self._process.join(LAST_WORDS_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _epitaph(self) -> str:
        self._process.join(LAST_WORDS_S)
        code = self._process.exitcode
        return f"the process {self._name} has ended with code {code}" + (" (killed; out of memory?)" if code == -signal.SIGKILL else "")


def serve(name: str, connection: Connection, make: Callable[..., Stoppable], arguments: tuple[Any, ...]) -> None:
    """Answer calls until told to end; runs in the process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends Ctrl-C to the whole group; the node tells when to end
    parent = multiprocessing.parent_process()
    assert parent is not None
    end_with_parent(parent.sentinel)
    logging.basicConfig(level=logging.INFO, format=f"[{name}] %(levelname)s %(message)s")
    keep_freed_memory()
    served = make(*arguments)
    try:
        while (asked := connection.recv()) is not None:
            connection.send(_answer(served, *asked))
    except (EOFError, OSError):  # nobody listens any more
        return
    finally:
        served.stop()


def _answer(served: object, method: str, arguments: tuple[Any, ...]) -> Any:
    try:
        return getattr(served, method)(*arguments)
    except (EngineError, ThegraError) as error:
        return error
    except Exception:
        return EngineError(traceback.format_exc())
