"""How many threads a process uses, as a process of its own tells."""

from __future__ import annotations

import os
import subprocess
import sys

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
