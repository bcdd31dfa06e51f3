"""Many tasks at once: on this machine, or on the workers of a Dask cluster that is there already."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import replace
from typing import Any

from thegra_core.errors import ConfigError
from thegra_core.evaluation.tasks import Outcome, RunTask, execute

CONNECT_S = 10.0
"""How long a scheduler may take to answer."""
Runner = Callable[[RunTask], Outcome]
Told = Callable[[int, Outcome], None]


def run_tasks(tasks: Sequence[RunTask], told: Told, workers: int = 1, dask: str | None = None, runner: Runner = execute) -> list[Outcome]:
    """Outcomes of tasks in their order, whichever ends first; a task that fails, or whose worker dies, is an outcome and stops nothing.

    Args:
        told: Called in this thread with the place and the outcome of each task when it is done.
        workers: Tasks at a time on this machine, each a process of its own.
        dask: Address of a scheduler; its workers need Thegra and the same files under the same paths.
        runner: What does a task.

    Raises:
        ConfigError: If the scheduler cannot be reached, or `distributed` is not installed.
    """
    if dask is not None:
        return _on_dask(tasks, told, dask, runner)
    threads = max(1, (os.cpu_count() or 1) // workers)
    shared = [replace(task, threads=threads) if workers > 1 else task for task in tasks]
    with ThreadPoolExecutor(max_workers=workers) as pool:
        places = {pool.submit(runner, task): i for i, task in enumerate(shared)}
        try:
            return _collect(as_completed(places), places, told)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _on_dask(tasks: Sequence[RunTask], told: Told, address: str, runner: Runner) -> list[Outcome]:
    try:
        from distributed import Client
        from distributed import as_completed as dask_completed
    except ImportError as error:
        raise ConfigError("--dask needs the package distributed; type: pip install -e .[dask]") from error
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise ConfigError(f"--dask {address}: no scheduler answers there ({error}); start one with `dask scheduler` and workers with `dask worker {address}`") from error
    with client, client.as_current():
        # two equal calls are two runs: pure would merge them; retries are the user's to decide
        places = {client.submit(runner, task, pure=False, retries=0, key=f"thegra-{os.getpid()}-{i}"): i for i, task in enumerate(tasks)}
        return _collect(dask_completed(places), places, told)


def _collect(done: Any, places: dict[Any, int], told: Told) -> list[Outcome]:
    outcomes: dict[int, Outcome] = {}
    for future in done:
        outcomes[places[future]] = outcome = _outcome_of(future)
        told(places[future], outcome)
    return [outcomes[i] for i in range(len(places))]


def _outcome_of(future: Future[Outcome]) -> Outcome:
    try:
        return future.result()
    except Exception as error:  # a worker may die of anything
        return Outcome(-1, error=f"{type(error).__name__}: {error}")
