"""Threads and memory of a process, as one of its own tells."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

TELL = """
import numpy, scipy.linalg, threadpoolctl
from thegra_core.process import set_threads
blas = lambda: {lib["num_threads"] for lib in threadpoolctl.threadpool_info() if lib["user_api"] == "blas"}
before = blas()
set_threads(COUNT)
import cv2
print(before == blas(), blas() == {COUNT}, cv2.getNumThreads())
"""


def told(count: int) -> list[str]:
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")} | {"OPENBLAS_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", TELL.replace("COUNT", str(count))], check=True, capture_output=True, text=True, env=environment)
    return done.stdout.split()


def test_a_count_of_threads_is_that_of_every_library() -> None:
    assert told(1)[1:] == ["True", "1"]


def test_without_a_count_the_linear_algebra_is_left_alone() -> None:
    assert told(0)[0] == "True"


HOLD = """
import numpy
from thegra_core.evaluation.benchmark.memory import resident_mb
from thegra_core.process import give_back_memory, keep_freed_memory
import os
keep_freed_memory()
memory = lambda: resident_mb(os.getpid())
before = memory()
held = [numpy.ones(5000) for _ in range(5000)]
last = numpy.ones(5000)  # so that the end of the heap stays in use
print(memory() - before)
held.clear()
print(memory() - before)
give_back_memory()
print(memory() - before)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="malloc's settings are glibc's")
def test_freed_memory_is_kept_until_it_is_given_back() -> None:
    done = subprocess.run([sys.executable, "-c", HOLD], check=True, capture_output=True, text=True)
    held, kept, given_back = map(float, done.stdout.split())
    assert held > 180 and kept > 150 and given_back < 20
