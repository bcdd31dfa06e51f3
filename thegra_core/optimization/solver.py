"""Who solves a large adjustment: whoever asks for the result, or a process beside this one while the caller goes on."""

from __future__ import annotations

import logging
import pickle
import subprocess
import sys
import threading
from dataclasses import dataclass, field
from typing import Protocol

from thegra_core.lifeline import Lifeline
from thegra_core.optimization.bundle import BundleProblem, BundleResult, bundle_adjust

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class BundleTask:
    """A bundle adjustment with its settings (see `bundle_adjust`): arrays and numbers only, so that it can be solved anywhere."""

    problem: BundleProblem
    huber_px: float
    chi2_px2: float
    iterations: int
    tolerance: float
    solver: str = "gtsam"
    freedom: float = 0.0
    weighings: int = 1

    def solve(self) -> BundleResult:
        """The adjustment, in this thread."""
        return bundle_adjust(self.problem, self.huber_px, self.chi2_px2, self.iterations, self.tolerance, self.solver, self.freedom, self.weighings)


class PendingBundle(Protocol):
    """A task that was handed in."""

    @property
    def ready(self) -> bool:
        """Whether the result is there, so that asking for it is worth the while."""

    def result(self) -> BundleResult | None:
        """The result, waited for if need be; None if the work failed."""

    def cancel(self) -> None:
        """The result is no longer wanted."""


class BundleSolver(Protocol):
    """Takes tasks."""

    def submit(self, task: BundleTask) -> PendingBundle:
        """Hand a task in; returns at once."""


@dataclass(frozen=True, slots=True)
class InlineSolver:
    """Tasks are solved by the one who asks for the result: always the same result at the same moment of a run."""

    def submit(self, task: BundleTask) -> PendingBundle:
        """See `BundleSolver.submit`."""
        return _Inline(task)


@dataclass(frozen=True, slots=True)
class ProcessSolver:
    """Each task is solved by a process of its own, which ends with it, or with the caller's.

    gtsam holds the interpreter's lock while it solves, so a thread would stop its caller all the same. A new interpreter rather than a fork or a child of
    `multiprocessing`: it works whatever threads the caller runs, and from within a daemon process, too.
    """

    def submit(self, task: BundleTask) -> PendingBundle:
        """See `BundleSolver.submit`."""
        return _InProcess(task)


@dataclass(frozen=True, slots=True)
class _Inline:
    task: BundleTask

    @property
    def ready(self) -> bool:
        return True

    def result(self) -> BundleResult | None:
        return self.task.solve()

    def cancel(self) -> None:
        pass


@dataclass
class _InProcess:
    """A thread feeds the task to the process and waits for what comes back; both only wait for pipes, without the lock."""

    task: BundleTask
    _answer: BundleResult | None = None
    _lifeline: Lifeline = field(init=False)
    _process: subprocess.Popen[bytes] = field(init=False)
    _thread: threading.Thread = field(init=False)
    _cancelled: bool = False

    def __post_init__(self) -> None:
        self._lifeline = Lifeline()
        command = [sys.executable, "-m", f"{__package__}.solve", str(self._lifeline.fd)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=[self._lifeline.fd])
        self._lifeline.handed_over()
        self._thread = threading.Thread(target=self._exchange, daemon=True, name="full adjustment")
        self._thread.start()

    @property
    def ready(self) -> bool:
        return not self._thread.is_alive()

    def result(self) -> BundleResult | None:
        self._thread.join()
        return self._answer

    def cancel(self) -> None:
        self._cancelled = True
        self._process.kill()
        self._thread.join()

    def _exchange(self) -> None:
        output, _ = self._process.communicate(pickle.dumps(self.task, pickle.HIGHEST_PROTOCOL))
        self._lifeline.cut()
        if self._process.returncode == 0:
            self._answer = pickle.loads(output)
        elif not self._cancelled:
            logger.warning("a full adjustment failed: its process ended with code %d", self._process.returncode)
