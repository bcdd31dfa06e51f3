"""A real Dask scheduler with two workers on loopback gives what local workers give."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from bag_making import write_ros1
from dataset_making import pretend, thermal

from thegra_core.evaluation.tasks import Outcome, RunTask, execute
from thegra_core.evaluation.workers import run_tasks

distributed = pytest.importorskip("distributed", reason="Dask is not installed: pip install -e .[dask]")
HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]


def dies(task: RunTask) -> Outcome:
    """A worker that is killed in the middle of the task named lt9; the others are done."""
    if task.name.startswith("lt9"):
        os.kill(os.getpid(), signal.SIGKILL)
    return pretend(task)


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a scheduler with two workers that know this folder's modules."""
    folder = tmp_path_factory.mktemp("dask")
    path = os.pathsep.join([str(HERE), str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": path, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}

    def start(*words: str) -> subprocess.Popen[str]:
        return subprocess.Popen([sys.executable, "-m", "distributed.cli." + words[0], *words[1:]], cwd=folder, env=environment, stderr=subprocess.PIPE, text=True)

    started = [start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-jupyter")]
    try:
        address = next(match[1] for line in started[0].stderr if (match := re.search(r"Scheduler at:\s+(tcp://\S+)", line)))
        started += [start("dask_worker", address, "--nthreads", "1", "--no-dashboard", "--local-directory", str(folder / f"w{i}")) for i in range(2)]
        with distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=120)
        yield address
    finally:
        for process in reversed(started):
            process.terminate()
        for process in started:
            process.communicate(timeout=60)


def tasks(folder: Path, names: list[str]) -> list[RunTask]:
    bag = write_ros1(folder / "a.bag", thermal()) if not (folder / "a.bag").exists() else folder / "a.bag"
    return [RunTask(name, bag, folder / "out" / name, ("--seed", str(i))) for i, name in enumerate(names)]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_dask_workers_do_as_local_ones(scheduler: str, tmp_path: Path) -> None:
    names = ["a0", "lt2", "lt1", "lt3", "a1", "a2"]
    told: list[int] = []
    on_dask = run_tasks(tasks(tmp_path, names), lambda place, _: told.append(place), dask=scheduler, runner=pretend)
    assert sorted(told) == list(range(6))
    assert on_dask[0].metrics["ate_rmse"] == 0.1 and on_dask[5].metrics["ate_rmse"] == 0.6
    assert [o.error for o in on_dask] == [None, "thegra: no\n camera", None, "RuntimeError: the worker was eaten", None, None]
    again = run_tasks(tasks(tmp_path, names), lambda *_: None, workers=2, runner=pretend)
    assert [(o.metrics, o.error) for o in again] == [(o.metrics, o.error) for o in on_dask]
    assert [o.resumed for o in again] == [True, False, True, False, True, True]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_worker_that_is_killed_costs_its_task_only(scheduler: str, tmp_path: Path) -> None:
    outcomes = run_tasks(tasks(tmp_path, ["a0", "lt9", "a1"]), lambda *_: None, dask=scheduler, runner=dies)
    assert [o.error is None for o in outcomes] == [True, False, True]
    assert "KilledWorker" in outcomes[1].error


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_real_run_on_a_worker_is_the_run_that_is_made_here(scheduler: str, tmp_path: Path) -> None:
    from thegra_core.simulation.simulate import SimulationOptions, simulate

    bag = simulate(SimulationOptions(duration_s=2.4, rate_hz=5, image_size=(320, 256), seed=1, sensor={"netd_mk": 20}), tmp_path / "bag")
    options = ("--set", "extractor.name=orb", "--set", "preprocessing.filters=[{filter: he_clip}]")
    there, here = (RunTask("demo", bag, tmp_path / name, options, bag / "groundtruth.txt") for name in ("there", "here"))
    (outcome,) = run_tasks([there], lambda *_: None, dask=scheduler)
    assert outcome.error is None
    assert execute(here).error is None
    assert (tmp_path / "there" / "trajectory.txt").read_bytes() == (tmp_path / "here" / "trajectory.txt").read_bytes()
    assert (tmp_path / "here" / "trajectory.txt").read_bytes().count(b"\n") >= 5
