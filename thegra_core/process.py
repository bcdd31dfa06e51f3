"""How this process uses the machine: threads and memory. Called once, where a process starts; nothing here changes a result. What it has used, and how it gets work done elsewhere."""

from __future__ import annotations

import ctypes
import os
import resource
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

MOST_THREADS = 4
"""Of the networks by default; a keyframe's 1024 points do not fill more."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # glibc's malloc.h
_KEPT_BYTES = 512 << 20
_LARGEST_BYTES = 256 << 20


def most_threads() -> int:
    """One a core that this process may use, `MOST_THREADS` at most."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, MOST_THREADS)


def set_threads(count: int) -> None:
    """Tell OpenMP, which reads it when torch is imported (a cache may make that unnecessary), how many threads to use, and to wait briefly, then sleep.

    Threads that wait for each other by spinning are fastest on idle cores and far slower on busy ones, threads that sleep at once the other way round.
    A brief wait is near the better of the two in both cases (measured).

    Args:
        count: 0: one a core, `MOST_THREADS` at most. `OMP_NUM_THREADS` wins over it. A count given is OpenCV's and numpy's, too, which else take all cores: a
            product of small matrices then waits for a thread on a core that mapping has.
    """
    os.environ.setdefault("OMP_NUM_THREADS", str(count or most_threads()))
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.setdefault("GOMP_SPINCOUNT", "3000")
    if count:
        import cv2
        from threadpoolctl import threadpool_limits

        cv2.setNumThreads(count)
        threadpool_limits(count, user_api="blas")  # of the libraries that are loaded; those to come read OMP_NUM_THREADS


def keep_freed_memory() -> None:
    """Let malloc reuse the memory of images and network layers instead of asking the kernel for it, page by page, every time.

    Total-variation denoising takes half the time so, and networks 0.8 of it (measured). Only glibc has the two settings; elsewhere this does nothing.
    """
    if not sys.platform.startswith("linux"):
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return
    mallopt(_M_MMAP_THRESHOLD, _LARGEST_BYTES)
    mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)


def give_back_memory() -> None:
    """Return to the kernel what `keep_freed_memory` has kept, where much was freed at once, as with a map. Takes some milliseconds; glibc's, elsewhere nothing."""
    if sys.platform.startswith("linux"):
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)


Submit = Callable[..., "Future[Any]"]
"""Has a function of a module called with the arguments given, now or elsewhere."""


def call_now(function: Callable[..., Any], *arguments: Any) -> Future[Any]:
    """Call it here; the future is done. What it raises is raised."""
    future: Future[Any] = Future()
    future.set_result(function(*arguments))
    return future


@dataclass(frozen=True, slots=True)
class Usage:
    """What a process has used so far: seconds of all cores, and the most memory at a time in MiB."""

    cpu_s: float = 0.0
    peak_rss_mb: float = 0.0


def own_usage() -> Usage:
    """Usage of this process, without its children."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return Usage(time.process_time(), peak / (1 << 20) if sys.platform == "darwin" else peak / 1024)
