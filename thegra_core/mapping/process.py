"""Mapping in a process of its own, so that tracking never waits for it: bundle adjustment holds Python's global lock for a whole solve.

One connection carries pickled messages both ways, in order. What tracking hands over is written by a thread, for the process reads nothing while it
solves. The process ends when the connection does, and at once with the process that it belongs to.
"""

from __future__ import annotations

import gc
import logging
import os
import queue
import socket
import subprocess
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from thegra_core.config import ThegraConfig
from thegra_core.errors import MappingError, ThegraError
from thegra_core.features.protocols import Matcher
from thegra_core.geometry.camera import CameraModel
from thegra_core.lifeline import Lifeline, end_with_parent
from thegra_core.map.map import Map
from thegra_core.mapping.mapper import Mapper
from thegra_core.mapping.service import InlineMapping
from thegra_core.messages import InitialMap, Keyframe, MapUpdate
from thegra_core.optimization.solver import ProcessSolver
from thegra_core.process import Usage, give_back_memory, keep_freed_memory, own_usage

logger = logging.getLogger(__name__)
LAST_WORDS_S = 5.0
"""How long an ending process may take before it is killed."""
NICENESS = 4
"""Tracking goes first where cores are few."""
_END = None
_LAUNCH = f"import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); from {__name__} import main; main()"
"""A terminal sends Ctrl-C to all processes, but it is meant for tracking, which tells when to end: it is ignored before anything else is imported."""
MakeMatcher = Callable[[ThegraConfig], Matcher]
"""Builds the matcher in the process; must be a function of a module, which is pickled by its name."""


class MappingProcess:
    """`MappingService` in a process of its own with one thread.

    Work is left out where more waits, and full adjustments have processes of their own.

    Raises:
        WeightsError: If the matcher's weights are not there; from the first call that waits for an answer, or `updates`.
    """

    def __init__(self, camera: CameraModel, config: ThegraConfig, make_matcher: MakeMatcher) -> None:
        ours, theirs = socket.socketpair()
        self._lifeline = Lifeline()
        with theirs:
            command = [sys.executable, "-c", _LAUNCH, str(theirs.fileno()), str(self._lifeline.fd)]
            environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
            self._process = subprocess.Popen(command, pass_fds=[theirs.fileno(), self._lifeline.fd], env=environment)
        self._lifeline.handed_over()
        self._connection = Connection(ours.detach())
        self._outbox: queue.SimpleQueue[tuple[str, tuple[Any, ...]] | None] = queue.SimpleQueue()
        self._writer = threading.Thread(target=self._write, name="thegra mapping writer", daemon=True)
        self._writer.start()
        self._updates: list[MapUpdate] = []
        self._submitted: deque[Future[Any]] = deque()
        self._tell("equip", config, make_matcher)
        self._tell("begin", camera)

    def begin(self, camera: CameraModel) -> None:
        """Forget all maps, for another stream or camera: a new process would load everything again. Waits for what is in work.

        Raises:
            MappingError: If mapping has ended with an error.
        """
        self._tell("begin", camera)
        self._ask("usage")
        self._updates.clear()

    def initialize(self, initial: InitialMap) -> None:
        """See `MappingService.initialize`."""
        self._tell("initialize", initial)

    def insert(self, keyframe: Keyframe) -> None:
        """See `MappingService.insert`."""
        self._tell("insert", keyframe)

    def drop(self, map_id: int) -> None:
        """See `MappingService.drop`."""
        self._tell("drop", map_id)

    def updates(self, patience_s: float = 0.0) -> list[MapUpdate]:
        """See `MappingService.updates`."""
        while self._readable(0.0 if self._updates else patience_s):
            self._take(self._receive())
            patience_s = 0.0
        taken, self._updates = self._updates, []
        return taken

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """See `MappingService.submit`."""
        self._submitted.append(Future())
        self._tell("call", function, *arguments)
        return self._submitted[-1]

    def load(self, path: Path) -> MapUpdate:
        """See `MappingService.load`."""
        update: MapUpdate = self._ask("load", path)
        return update

    def save(self, path: Path) -> None:
        """See `MappingService.save`."""
        self._ask("save", path)

    def finish(self) -> list[MapUpdate]:
        """See `MappingService.finish`."""
        last: list[MapUpdate] = self._ask("finish")
        return [*self.updates(), *last]

    def maps(self) -> list[Map]:
        """See `MappingService.maps`."""
        maps: list[Map] = self._ask("maps")
        return maps

    def counts(self) -> tuple[int, int]:
        """See `MappingService.counts`."""
        loops, merges = self._ask("counts")
        return loops, merges

    def usage(self) -> Usage:
        """See `MappingService.usage`."""
        usage: Usage = self._ask("usage")
        return usage

    def close(self) -> None:
        """See `MappingService.close`."""
        if self._connection.closed:
            return
        self._outbox.put(_END)
        self._process.terminate()
        try:
            self._process.wait(LAST_WORDS_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._writer.join()
        self._connection.close()
        self._lifeline.cut()

    # ---- steps ----------------------------------------------------------------------------------------------------------------------

    def _tell(self, name: str, *arguments: Any) -> None:
        self._outbox.put((name, arguments))

    def _ask(self, name: str, *arguments: Any) -> Any:
        self._tell(name, *arguments)
        while True:
            kind, content = self._receive()
            if kind == "answer":
                return content
            if kind == "refusal":
                raise content
            self._take((kind, content))

    def _take(self, message: tuple[str, Any]) -> None:
        kind, content = message
        if kind == "failed":
            if isinstance(content, ThegraError):
                raise content
            raise MappingError(f"the process of the mapping stage has failed:\n{content}")
        if kind == "result":
            self._submitted.popleft().set_result(content)
            return
        self._updates.extend(content)

    def _readable(self, patience_s: float) -> bool:
        try:
            return self._connection.poll(patience_s)
        except OSError as error:
            raise MappingError(self._epitaph()) from error

    def _receive(self) -> tuple[str, Any]:
        try:
            message: tuple[str, Any] = self._connection.recv()
        except (EOFError, OSError) as error:
            raise MappingError(self._epitaph()) from error
        return message

    def _epitaph(self) -> str:
        try:
            code: int | None = self._process.wait(LAST_WORDS_S)
        except subprocess.TimeoutExpired:
            code = None
        killed = " (killed; out of memory?)" if code == -9 else ""
        return f"the process of the mapping stage has ended with code {code}{killed}"

    def _write(self) -> None:
        while (message := self._outbox.get()) is not _END:
            try:
                self._connection.send(message)
            except OSError:  # it has ended; who reads is told
                return


class _Inbox:
    """What comes over a connection, in order, with a look at what waits."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._waiting: deque[tuple[str, tuple[Any, ...]]] = deque()

    def next(self) -> tuple[str, tuple[Any, ...]]:
        """Wait for the next message.

        Raises:
            EOFError, OSError: If the connection has ended.
        """
        return self._waiting.popleft() if self._waiting else self._connection.recv()

    def work_waits(self) -> bool:
        """Whether tracking waits for a keyframe or a first map to be worked on."""
        while self._connection.poll():
            self._waiting.append(self._connection.recv())
        return any(name in ("insert", "call") for name, _ in self._waiting)


def serve(connection: Connection) -> None:
    """Do what comes over the connection, in order, until it ends."""
    inbox = _Inbox(connection)
    mapping: InlineMapping | None = None
    config: ThegraConfig
    matcher: Matcher
    while True:
        try:
            name, arguments = inbox.next()
        except (EOFError, OSError):
            return
        try:
            if name == "equip":
                config, make_matcher = arguments
                matcher = make_matcher(config)
                continue
            if name == "begin":
                if mapping is not None:
                    for known in mapping.maps():  # also what is solved for them elsewhere
                        mapping.drop(known.map_id)
                (camera,) = arguments
                mapping = InlineMapping(Mapper(camera, config, matcher, ProcessSolver()))
                gc.collect()
                give_back_memory()
                continue
            assert mapping is not None
            for answer in _do(mapping, name, arguments, inbox.work_waits):
                connection.send(answer)
        except (ConnectionError, EOFError):  # who asked has gone
            return
        except Exception as error:
            connection.send(("failed", error if isinstance(error, ThegraError) else traceback.format_exc()))
            return


def _do(mapping: InlineMapping, name: str, arguments: tuple[Any, ...], others_wait: Callable[[], bool]) -> Iterator[tuple[str, Any]]:
    """What is to be sent back, each as soon as it is there."""
    if name == "insert":
        (keyframe,) = arguments
        for update in mapping.insert_by_steps(keyframe, others_wait):
            yield "updates", [update]
    elif name in ("initialize", "drop"):
        getattr(mapping, name)(*arguments)
        yield "updates", mapping.updates()
    elif name == "call":
        function, *rest = arguments
        yield "result", function(*rest)
    elif name == "usage":
        yield "answer", own_usage()
    else:
        try:
            yield "answer", getattr(mapping, name)(*arguments)
        except ThegraError as error:
            yield "refusal", error


def main() -> None:
    """The process: its arguments are the file descriptors of the connection and of the lifeline."""
    end_with_parent(int(sys.argv[2]))
    os.nice(NICENESS)
    logging.basicConfig(level=logging.WARNING, format="[thegra mapping] %(levelname)s %(message)s")
    keep_freed_memory()
    serve(Connection(int(sys.argv[1])))
