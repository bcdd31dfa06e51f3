"""The system as a node uses it: frames in, results out, in a process of its own or in this one. No ROS here.

Bundle adjustment holds Python's global lock while it solves; in the node's process it would starve the callbacks that receive images.
"""

from __future__ import annotations

import logging
import multiprocessing
import signal
import threading
import time
import traceback
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Protocol

from thegra_core.config import ThegraConfig
from thegra_core.errors import ThegraError
from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import Frame, MapSummary, Snapshot, TrackingResult
from thegra_core.process import keep_freed_memory, set_threads

if TYPE_CHECKING:
    from thegra_core.features.protocols import Extractor, Matcher
    from thegra_core.slam import Slam

_log = logging.getLogger(__name__)
LAST_WORDS_S = 1.0
"""How long the process may take to end by itself when it is told to."""


class EngineError(Exception):
    """The system could not work on a frame; the next frame begins a new map."""


@dataclass(frozen=True, slots=True)
class Job:
    """A frame and what is wanted beside its result. Another `epoch` than the last job's begins a new map."""

    frame: Frame
    camera: CameraModel
    epoch: int
    wants_view: bool = False
    wants_map: bool = False


@dataclass(frozen=True, slots=True)
class Done:
    """A job's result; `view` and `map` where they were wanted and there are any."""

    result: TrackingResult
    view: Snapshot | None = None
    map: MapSummary | None = None


class Engine(Protocol):
    """What works on frames, one at a time."""

    def start(self) -> None:
        """Load the networks.

        Raises:
            ThegraError: If something the user can put right is missing.
        """

    def process(self, job: Job) -> Done:
        """Work on a frame, waiting for the result.

        Raises:
            EngineError: If it failed.
        """

    def stop(self) -> None:
        """End soon; a frame in work is given up. May be called from any thread."""


class LocalEngine:
    """The system in the calling thread; `beside`: but for mapping, which then has a process of its own."""

    def __init__(self, config: ThegraConfig, beside: bool = False) -> None:
        self._config = config
        self._beside = beside
        self._networks: tuple[Extractor, Matcher] | None = None
        self._slam: Slam | None = None
        self._epoch = -1

    def start(self) -> None:
        set_threads(self._config.threads)
        from thegra_core.features.registry import make_extractor, make_matcher

        self._networks = make_extractor(self._config.extractor), make_matcher(self._config.matcher, self._config.extractor)

    def process(self, job: Job) -> Done:
        slam = self._slam_for(job)
        try:
            result = slam.process(job.frame)
            view = slam.snapshot() if job.wants_view else None
            return Done(result, view, slam.current_map() if job.wants_map else None)
        except Exception as error:
            self.stop()
            raise EngineError(traceback.format_exc()) from error

    def stop(self) -> None:
        if self._slam is not None:
            self._slam.close()
        self._slam = None

    def _slam_for(self, job: Job) -> Slam:
        if self._slam is None or job.epoch != self._epoch:
            from thegra_core.slam import Slam

            if self._networks is None:
                self.start()
            self.stop()
            self._slam, self._epoch = Slam(job.camera, self._config, *(self._networks or ()), beside=self._beside), job.epoch
        return self._slam


class ProcessEngine:
    """The system in a process of its own, which ends with this one."""

    def __init__(self, config: ThegraConfig) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs, config), daemon=True, name="thegra engine")
        self._theirs = theirs
        self._sending = threading.Lock()

    def start(self) -> None:
        self._process.start()
        self._theirs.close()
        answer = self._receive()
        if isinstance(answer, ThegraError):
            raise answer

    def process(self, job: Job) -> Done:
        try:
            with self._sending:
                self._connection.send(job)
        except OSError as error:
            raise EngineError(self._epitaph()) from error
        answer = self._receive()
        if isinstance(answer, Done):
            return answer
        raise EngineError(str(answer))

    def stop(self) -> None:
        if self._process.pid is None:
            return
        try:
            with self._sending:
                self._connection.send(None)
        except (OSError, ValueError):  # it has gone already
            _log.debug("the engine's process has gone already")
        self._process.join(LAST_WORDS_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    @property
    def alive(self) -> bool:
        return self._process.is_alive()

    def _receive(self) -> object:
        try:
            return self._connection.recv()
        except (EOFError, OSError) as error:
            raise EngineError(self._epitaph()) from error

    def _epitaph(self) -> str:
        self._process.join(LAST_WORDS_S)
        code = self._process.exitcode
        return f"the process of the SLAM system has ended with code {code}" + (" (killed; out of memory?)" if code == -signal.SIGKILL else "")


def serve(connection: Connection, config: ThegraConfig) -> None:
    """Work on jobs until told to end or the other end is gone; runs in the engine's process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends Ctrl-C to the whole group; the node tells when to end
    logging.basicConfig(level=logging.INFO, format="[thegra engine] %(levelname)s %(message)s")
    keep_freed_memory()
    engine = LocalEngine(config, beside=True)
    begin = time.perf_counter()
    try:
        engine.start()
    except ThegraError as error:
        connection.send(error)
        return
    connection.send("ready")
    _log.info("networks loaded in %.1f s", time.perf_counter() - begin)
    try:
        _answer(connection, engine)
    finally:
        engine.stop()


def _answer(connection: Connection, engine: LocalEngine) -> None:
    while True:
        try:
            job = connection.recv()
        except (EOFError, OSError):
            return
        if job is None:
            return
        try:
            answer: object = engine.process(job)
        except EngineError as error:
            answer = str(error)
        try:
            connection.send(answer)
        except OSError:
            return
