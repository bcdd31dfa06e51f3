"""The whole system over many recordings: every recording with every profile and seed, each run in a process of its own, scored against ground truth.

A run is the command `thegra run` itself, so that what is measured (memory, start, files) is what a user gets, and no run sees what another left behind.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from thegra_core.config import load_config, parse_assignments
from thegra_core.errors import InputError
from thegra_core.evaluation.benchmark.comparison import Comparison, Scored, compare
from thegra_core.evaluation.benchmark.machine import machine
from thegra_core.evaluation.benchmark.memory import PeakMemory
from thegra_core.evaluation.benchmark.peers import best_peer, median_or_none
from thegra_core.evaluation.scores import read_intervals, read_stamps
from thegra_core.evaluation.tasks import RAN, run_process
from thegra_core.messages import FloatArray
from thegra_core.outputs.files import write_atomic, writing_to
from thegra_core.outputs.scoring import MIN_COVERAGE_PCT, score_trajectory, spread_of, within
from thegra_core.outputs.trajectory import Trajectory, read_tum
from thegra_core.sources.open import open_recording
from thegra_core.version import VERSION

_FROM_METRICS = ("frames_total", "maps", "losses", "relocalizations", "loops", "shutter_closures", "keyframes", "landmarks", "finish_s", "cached_pct")
_COUNTED = ("tracked_pct", "recall_1pct")
"""Figures for which a frame without a pose is a miss already."""
_STILL = 1e-6


@dataclass(frozen=True, slots=True)
class Plan:
    """What to run: every recording with every profile and the seeds 0 to runs - 1.

    max_frames maps a recording's name (that of its folder or file) to the frames it is cut to. assignments are `key=value` parameters. realtime: each
    recording is played at its own rate. workers: runs at a time.
    """

    recordings: tuple[Path, ...]
    out: Path
    profiles: tuple[str, ...] = ("quality",)
    runs: int = 1
    cache: Path | None = None
    max_frames: Mapping[str, int] = field(default_factory=dict)
    assignments: tuple[str, ...] = ()
    realtime: bool = False
    workers: int = 1


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """One run of the plan; its files go to `folder`."""

    recording: Path
    profile: str
    seed: int
    folder: Path
    max_frames: int | None

    @property
    def name(self) -> str:
        return recording_name(self.recording)


@dataclass(frozen=True, slots=True)
class RunResult:
    """How a run ended; `figures` is empty and `error` says why where it failed."""

    run: PlannedRun
    exit_code: int
    figures: Mapping[str, Any]
    error: str | None = None


def planned_runs(plan: Plan) -> list[PlannedRun]:
    """All runs in order: recording, then profile, then seed.

    Raises:
        InputError: If a recording does not exist, or two have the same name, or `max_frames` names none.
        ConfigError: If a profile or an assignment is not understood.
    """
    names = [recording_name(path) for path in plan.recordings]
    for path in plan.recordings:
        if not path.exists():
            raise InputError(f"{path} does not exist; give folders or files that `thegra run` takes")
    if len(set(names)) < len(names):
        raise InputError(f"recordings need different names to tell their results apart, got {', '.join(sorted(names))}; run the command once for each")
    unknown = sorted(set(plan.max_frames) - set(names))
    if unknown:
        raise InputError(f"--max-frames {unknown[0]}=...: no recording is called that; there are {', '.join(names)}")
    for profile in plan.profiles:
        load_config(profile, None, parse_assignments(plan.assignments))
    return [
        PlannedRun(path, profile, seed, plan.out / name / profile / f"seed{seed}", plan.max_frames.get(name))
        for path, name in zip(plan.recordings, names, strict=True)
        for profile in plan.profiles
        for seed in range(plan.runs)
    ]


def run_plan(plan: Plan, before: Callable[[PlannedRun], None], after: Callable[[Sequence[RunResult]], None]) -> list[RunResult]:
    """Run everything; `before` is told what starts, in the thread that starts it, `after` all results so far, in order, each time one is there.

    A failed run stops nothing.

    Raises:
        ThegraError: As `planned_runs`, before anything runs.
    """
    runs = planned_runs(plan)
    results: dict[int, RunResult] = {}

    def started(run: PlannedRun) -> RunResult:
        before(run)
        return execute(run, plan)

    with ThreadPoolExecutor(plan.workers) as pool:
        places = {pool.submit(started, run): i for i, run in enumerate(runs)}
        try:
            for done in as_completed(places):
                results[places[done]] = done.result()
                after([results[i] for i in sorted(results)])
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return [results[i] for i in range(len(runs))]


def execute(run: PlannedRun, plan: Plan) -> RunResult:
    """One run in a process of its own, scored."""
    run.folder.mkdir(parents=True, exist_ok=True)
    for stale in (*run.folder.glob("*.json"), *run.folder.glob("*.txt")):
        stale.unlink()
    threads = max(1, (os.cpu_count() or 1) // plan.workers) if plan.workers > 1 else 0
    memory = PeakMemory()
    code, said = run_process(command(run, plan), threads, memory)
    if code not in RAN or not (run.folder / "metrics.json").is_file():
        return RunResult(run, code, {}, said or f"exit code {code}")
    try:
        return RunResult(run, code, figures_of(run) | {"peak_mb": round(memory.mb, 1)})
    except InputError as error:
        return RunResult(run, code, {}, str(error))


def command(run: PlannedRun, plan: Plan) -> list[str]:
    """The command line of a run."""
    options = [run.recording, "--profile", run.profile, "--seed", run.seed, "--out", run.folder, "--quiet"]
    options += ["--max-frames", run.max_frames] if run.max_frames is not None else []
    options += ["--realtime"] if plan.realtime else []
    options += ["--cache", plan.cache] if plan.cache is not None else []
    options += [word for assignment in plan.assignments for word in ("--set", assignment)]
    return [sys.executable, "-m", "thegra_core.cli.main", "run", *map(str, options)]


# ---- figures of one run -----------------------------------------------------------------------------------------------------------


def figures_of(run: PlannedRun) -> dict[str, Any]:
    """Figures of a finished run from its files: what it says of itself, and its score.

    `truth` is none, still (a reference that does not move tells no error) or moving; poses counts the poses claimed in all maps and extent
    is the longest diagonal of the box around one map's poses, in map units (the median depth of the first map is 1).

    Raises:
        InputError: If the ground truth or another file beside the recording cannot be read.
    """
    metrics = json.loads((run.folder / "metrics.json").read_text(encoding="utf-8"))
    trajectories = [read_tum(file) for file in sorted(run.folder.glob("trajectory*.txt")) if file.name != "trajectory_live.txt"]
    ms = metrics["ms_per_frame"]
    figures: dict[str, Any] = {key: metrics[key] for key in _FROM_METRICS}
    figures |= {
        "poses": sum(len(t) for t in trajectories),
        "extent": max((_diagonal(t.positions) for t in trajectories), default=0.0),
        "s_per_frame": {p: None if ms[p] is None else round(ms[p] / 1e3, 4) for p in ("p50", "p95")},
        "fps": metrics.get("fps"),
        "ms": metrics.get("ms", {}),
        "latency_ms": metrics.get("latency_ms"),
        "dropped_frames": metrics.get("dropped_frames", 0),
        "cpu_s_per_frame": metrics.get("cpu_s_per_frame"),
        "ms_stages": {stage: values["p50"] for stage, values in metrics.get("ms", {}).items()},
    }
    return figures | _scores(run, metrics)


def _scores(run: PlannedRun, metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Coverage and errors; over the images outside the closures of `shutter.txt` where one of `images.txt` and that is beside them, else as the run scored itself."""
    files = {name: run.recording / f"{name}.txt" for name in ("images", "shutter")}
    recording = open_recording(run.recording)
    truth_file = recording.groundtruth
    none = {"truth": "none", "tracked_pct": metrics["tracked_pct"], "ate_rmse": None, "ate_rel": None, "in_closure": 0, "spread": None}
    if truth_file is None or not any(file.is_file() for file in files.values()):
        truth = read_tum(truth_file) if truth_file is not None else None
        scored = {key: metrics.get(key) for key in ("ate_rmse", "ate_rel", "ate_pct", "ate_live_rmse", "recall_1pct", "rot_deg")}
        return none | scored | ({"truth": _kind(truth), "spread": spread_of(truth.positions)} if truth is not None else {})
    stamps = read_stamps(files["images"]) if files["images"].is_file() else np.sort(np.array([frame.stamp_ns for frame in recording.frames()], np.int64))
    stamps = stamps[: run.max_frames]
    truth = within(read_tum(truth_file), stamps)
    closures = read_intervals(files["shutter"]) if files["shutter"].is_file() else ()
    score, live = (score_trajectory(read_tum(run.folder / name), truth, stamps, closures_ns=closures) for name in ("trajectory.txt", "trajectory_live.txt"))
    return {key: getattr(score, key) for key in ("tracked_pct", "ate_rmse", "ate_rel", "ate_pct", "recall_1pct", "rot_deg", "in_closure")} | {
        "ate_live_rmse": live.ate_rmse if live.covered else None,
        "truth": _kind(truth),
        "spread": spread_of(truth.positions),
    }


def _kind(truth: Trajectory) -> str:
    return "moving" if len(truth) and _diagonal(truth.positions) > _STILL else "still"


def _diagonal(positions: FloatArray) -> float:
    return float(np.linalg.norm(np.ptp(positions, axis=0))) if len(positions) else 0.0


# ---- results of all runs ----------------------------------------------------------------------------------------------------------


def summarize(results: Sequence[RunResult]) -> dict[str, Any]:
    """Figures of the runs of one recording with one profile: medians and every seed's value; None of a seed stands for the worst.

    A run that tracks less than `MIN_COVERAGE_PCT` has no error here; `runs` has what there is.
    Time is that of the first run that did not fail; memory the most of any.
    """
    first = results[0].run
    ran = [r.figures for r in results if r.figures]
    summary: dict[str, Any] = {"recording": first.name, "profile": first.profile, "max_frames": first.max_frames, "seeds": [r.run.seed for r in results]}
    summary["failed"] = [{"seed": r.run.seed, "exit_code": r.exit_code, "error": r.error} for r in results if r.error is not None]
    for key in ("tracked_pct", "ate_rmse", "ate_rel", "ate_pct", "ate_live_rmse", "recall_1pct"):
        told = [f.get(key) if key in _COUNTED or f["tracked_pct"] >= MIN_COVERAGE_PCT else None for f in ran]
        values = iter(told)
        summary[key] = {
            "median": median_or_none(told, worst=0.0 if key in _COUNTED else np.inf),
            "seeds": [next(values) if r.figures else None for r in results],
        }
    for key in ("maps", "losses", "poses", "extent", "in_closure"):
        summary[key] = [r.figures.get(key) for r in results]
    summary |= {key: ran[0].get(key) if ran else None for key in ("truth", "spread", "s_per_frame", "cached_pct", "fps", "ms_stages")}
    summary["peak_mb"] = max((f["peak_mb"] for f in ran), default=None)
    summary["runs"] = [{"seed": r.run.seed, "folder": str(r.run.folder), "exit_code": r.exit_code} | dict(r.figures) for r in results]
    return summary


def comparisons(summaries: Sequence[Mapping[str, Any]]) -> list[Comparison]:
    """Each other profile beside the first, by the medians over the seeds, where the ground truth moves."""
    scored = [Scored(s["recording"], s["profile"], s["tracked_pct"]["median"], s["ate_rmse"]["median"]) for s in summaries if s["truth"] == "moving"]
    return compare(scored, scored[0].label) if scored else []


def report(plan: Plan, results: Sequence[RunResult], peers: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Everything `results.json` holds."""
    groups: dict[tuple[str, str], list[RunResult]] = {}
    for result in results:
        groups.setdefault((result.run.name, result.run.profile), []).append(result)
    summaries = [summarize(group) for group in groups.values()]
    return {
        "version": VERSION,
        "machine": machine(),
        "runs": plan.runs,
        "workers": plan.workers,
        "assignments": list(plan.assignments),
        "results": summaries,
        "comparisons": [asdict(comparison) for comparison in comparisons(summaries)],
        "peers": {name: best_peer(peers.get(name, {})) for name in dict.fromkeys(name for name, _ in groups)} if peers is not None else {},
    }


def write_report(plan: Plan, content: Mapping[str, Any], markdown: str) -> None:
    """`results.json` and `results.md` into the plan's folder.

    Raises:
        InputError: If it cannot be written.
    """
    with writing_to(plan.out):
        write_atomic(plan.out / "results.json", json.dumps(content, indent=2, allow_nan=False) + "\n")
        write_atomic(plan.out / "results.md", markdown)


def recording_name(path: Path) -> str:
    """Name of a recording in results and options: that of its folder or file."""
    return path.resolve().name
