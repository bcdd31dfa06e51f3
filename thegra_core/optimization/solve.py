"""The process of `ProcessSolver`: a pickled task from standard input, its pickled result to standard output; its argument is the lifeline."""

from __future__ import annotations

import os
import pickle
import signal
import sys
from contextlib import suppress

from thegra_core.lifeline import end_with_parent
from thegra_core.optimization.solver import BundleTask

NICENESS = 19
"""Tracking and local mapping go first where cores are few: a full adjustment is waited for by nobody."""


def main() -> None:
    """Solve one task."""
    end_with_parent(int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends Ctrl-C to the whole group; the caller decides
    os.nice(NICENESS)
    task = pickle.load(sys.stdin.buffer)
    assert isinstance(task, BundleTask)
    with suppress(BrokenPipeError):  # the caller has gone
        pickle.dump(task.solve(), sys.stdout.buffer, pickle.HIGHEST_PROTOCOL)
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
