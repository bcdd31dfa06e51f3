"""Recordings played at their own rate, with every profile: how long a pose takes, what is dropped, and what that costs in accuracy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from thegra_core.evaluation.benchmark.comparison import Comparison, Scored, compare, sentences
from thegra_core.evaluation.benchmark.machine import described, machine
from thegra_core.evaluation.benchmark.slam import Plan, PlannedRun, RunResult, execute, planned_runs, write_report
from thegra_core.evaluation.suite import SUITE, make_recording
from thegra_core.outputs.scoring import MIN_COVERAGE_PCT
from thegra_core.simulation.simulate import SimulationOptions
from thegra_core.version import VERSION

HEADER = (
    "recording", "profile", "dropped %", "latency ms p50 / p95 / p99", "CPU s/frame", "frame ms p50 / p95 / p99", "stages ms p50 / p95 / p99", "tracked %",
    "offline", "ATE", "live ATE", "offline ATE", "peak MB",
)  # fmt: skip
SEED = 7
"""Of the simulated recordings."""
_SHOWN_MS = 1.0


def simulated(folder: Path, sizes: Sequence[tuple[int, int]], rates: Sequence[float], duration_s: float, say: Callable[[str, int, int], None]) -> list[Path]:
    """The same walk through the same room, seen in each size (width, height) px at each rate (Hz); what is missing in `folder` is simulated.

    Raises:
        InputError: As `make_recording`.
    """
    made = []
    for width, height in sizes:
        for rate in rates:
            options = SimulationOptions.model_validate(
                {"scene": "room", "style": "robust", "shutter": "freeze", "seed": SEED, "duration_s": duration_s, "rate_hz": rate, "image_size": (width, height)}
            )
            made.append(make_recording(folder / f"room_{width}x{height}_{rate:g}hz_{duration_s:g}s", options, say))
    return made


def simulated_suite(folder: Path, sizes: Sequence[tuple[int, int]], rates: Sequence[float], say: Callable[[str, int, int], None]) -> list[Path]:
    """The sequences of the suite as other cameras would have seen them: in each size (width, height) px at each rate (Hz); what is missing is simulated.

    Raises:
        InputError: As `make_recording`.
    """
    return [
        make_recording(folder / f"{name}_{size[0]}x{size[1]}_{rate:g}hz", options.model_copy(update={"image_size": size, "rate_hz": rate}), say)
        for size in sizes
        for rate in rates
        for name, options in SUITE.items()
    ]


def benchmark(
    recordings: Sequence[Path], profiles: Sequence[str], out: Path, offline: bool, assignments: tuple[str, ...], say: Callable[[str], None], against: str | None = None
) -> dict[str, Any]:
    """Run everything, one at a time, and write `results.json` and `results.md`; returns what the former holds.

    against: A profile that runs each recording offline, too, without the assignments, for its errors to be compared with.

    Raises:
        ThegraError: As `planned_runs`, before anything runs.
    """
    live = Plan(tuple(recordings), out / "live", tuple(profiles), assignments=assignments, realtime=True)
    calm = Plan(tuple(recordings), out / "offline", tuple(profiles), assignments=assignments)
    other = Plan(tuple(recordings), out / "against", (against,) if against is not None else ())
    content: dict[str, Any] = {"version": VERSION, "machine": machine(), "assignments": list(assignments), "against": against, "results": [], "others": [], "comparisons": []}
    others = planned_runs(other)
    for run, again in zip(planned_runs(live), planned_runs(calm), strict=True):
        say(f"{run.name} {run.profile} at its own rate")
        played = execute(run, live)
        result: dict[str, Any] = {"recording": run.name, "profile": run.profile, "live": _figures(played), "offline": None, "failed": _failed(run, "live", played)}
        if offline:
            say(f"{run.name} {run.profile} offline")
            without_haste = execute(again, calm)
            result["offline"] = _figures(without_haste)
            result["failed"] += _failed(again, "offline", without_haste)
        content["results"].append(result)
        _write(content, out)
    for run in others:
        say(f"{run.name} {run.profile} offline, to compare with")
        done = execute(run, other)
        content["others"].append({"recording": run.name, "profile": run.profile, "offline": _figures(done), "failed": _failed(run, "offline", done)})
        _write(content, out)
    return content


def _write(content: dict[str, Any], out: Path) -> None:
    content["comparisons"] = [asdict(c) for c in _comparisons(content)]
    write_report(Plan((), out), content, markdown(content))


def _comparisons(content: Mapping[str, Any]) -> list[Comparison]:
    """Live maps, and those made without haste, beside the other profile's."""
    against = f"{content['against']} offline"
    scored = [_scored(other["recording"], against, other["offline"]) for other in content["others"]]
    scored += [_scored(r["recording"], f"{r['profile']} {how}", r[how]) for r in content["results"] for how in ("live", "offline")]
    return compare([s for s in scored if s is not None], against)


def _scored(recording: str, label: str, figures: Mapping[str, Any] | None) -> Scored | None:
    if figures is None:
        return None
    told = figures["ate_rmse"] if figures["tracked_pct"] >= MIN_COVERAGE_PCT else None
    return Scored(recording, label, figures["tracked_pct"], told)


def failures(content: Mapping[str, Any]) -> list[str]:
    """One line for each run that failed."""
    return [line for result in (*content["results"], *content["others"]) for line in result["failed"]]


def markdown(content: Mapping[str, Any]) -> str:
    """A GitHub table, a line that explains it, and the failures."""
    header = HEADER if content["against"] is None else (*HEADER, f"ATE of {content['against']}")
    beside = {other["recording"]: _error(other["offline"], "ate_rmse") for other in content["others"]}
    rows = [(*_row(r), *([beside.get(r["recording"], "–")] if content["against"] is not None else ())) for r in content["results"]]
    lines = [header, ("---",) * len(header), *rows]
    text = "".join("| " + " | ".join(line) + " |\n" for line in lines)
    settings = f"With {', '.join(content['assignments'])}. " if content["assignments"] else ""
    told = (
        f"{settings}Latency: from the frame's delivery to its pose. Frame: the work on it. CPU: of all processes. Memory: of all processes together, what they share counted once. Dropped frames count as not tracked. ATE: after Sim(3) "
        f"alignment, of the finished map; live: as estimated at the time. "
        f"Thegra {content['version']}, {described(content['machine'])}."
    )
    compared = "".join(f"\n{sentence}\n" for sentence in sentences(content["comparisons"]))
    return f"{text}\n{told}\n{compared}" + "".join(f"\nFailed: {line}\n" for line in failures(content))


def _figures(result: RunResult) -> dict[str, Any] | None:
    return dict(result.figures) if result.figures else None


def _failed(run: PlannedRun, how: str, result: RunResult) -> list[str]:
    return [] if result.error is None else [f"{run.name}, {run.profile}, {how} (exit code {result.exit_code}): {' '.join(result.error.split())}"]


def _row(result: Mapping[str, Any]) -> tuple[str, ...]:
    live, offline = result["live"], result["offline"]
    if live is None:
        return (result["recording"], result["profile"], "failed", *["–"] * (len(HEADER) - 3))
    stages = {stage: ms for stage, ms in live["ms"].items() if stage != "total" and ms["p50"] is not None and ms["p95"] >= _SHOWN_MS}
    return (
        result["recording"], result["profile"], f"{100 * live['dropped_frames'] / max(live['frames_total'], 1):.1f}", _percentiles(live["latency_ms"]),
        f"{live['cpu_s_per_frame']:.3f}", _percentiles(live["ms"].get("total")), ", ".join(f"{stage} {_percentiles(ms)}" for stage, ms in stages.items()) or "–",
        f"{live['tracked_pct']:.1f}", f"{offline['tracked_pct']:.1f}" if offline else "–", _error(live, "ate_rmse"), _error(live, "ate_live_rmse"),
        _error(offline, "ate_rmse"), f"{live['peak_mb']:.0f}",
    )  # fmt: skip


def _percentiles(values: Mapping[str, float | None] | None) -> str:
    return "–" if values is None or None in values.values() else " / ".join(f"{values[p]:.0f}" for p in ("p50", "p95", "p99"))


def _error(figures: Mapping[str, Any] | None, key: str) -> str:
    return "–" if figures is None or figures.get(key) is None else f"{figures[key]:.3g}"
