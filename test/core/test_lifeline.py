"""No process is left over when the one that it works for is gone."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys

from test_full_adjustment import CHI2, HUBER, problem

from thegra_core.lifeline import Lifeline
from thegra_core.optimization.solver import BundleTask

COMPUTES = """
import ctypes, sys
from thegra_core.lifeline import end_with_parent
end_with_parent(int(sys.argv[1]))
print("computes", flush=True)
ctypes.PyDLL(None).sleep(10**6)  # holds Python's lock, as gtsam does
"""
STARTS_IT = """
import subprocess, sys, time
from thegra_core.lifeline import Lifeline
line = Lifeline()
subprocess.Popen([sys.executable, "-c", sys.argv[1], str(line.fd)], pass_fds=[line.fd])
line.handed_over()
time.sleep(10**6)
"""


def test_a_child_that_computes_ends_with_a_parent_that_is_killed() -> None:
    with subprocess.Popen([sys.executable, "-c", STARTS_IT, COMPUTES], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == b"computes\n"
        parent.kill()
        assert parent.stdout.read() == b"", "the child held the other end, and is gone"


def test_a_parent_that_was_gone_before_ends_the_child() -> None:
    theirs, ours = os.pipe()
    os.close(ours)
    assert subprocess.run([sys.executable, "-c", COMPUTES, str(theirs)], pass_fds=[theirs], stdout=subprocess.PIPE, check=False).returncode == -signal.SIGKILL
    os.close(theirs)


def test_an_adjustment_ends_with_whom_it_is_for() -> None:
    line = Lifeline()
    solving = subprocess.Popen([sys.executable, "-m", "thegra_core.optimization.solve", str(line.fd)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=[line.fd])
    line.handed_over()
    with solving:
        assert solving.stdin is not None
        solving.stdin.write(pickle.dumps(BundleTask(problem(views=30, count=4000), HUBER, CHI2, 10**6, 0.0)))
        solving.stdin.close()
        line.cut()
        assert solving.wait() == -signal.SIGKILL
