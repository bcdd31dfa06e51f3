"""Results of `benchmark.slam` as text: rows for a terminal and a Markdown table for a README."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from thegra_core.evaluation.benchmark.comparison import sentences
from thegra_core.evaluation.benchmark.machine import described
from thegra_core.evaluation.benchmark.peers import PEER_COVERAGE_PCT
from thegra_core.outputs.scoring import MIN_COVERAGE_PCT

HEADER = ("recording", "profile", "tracked %", "ATE RMSE", "of spread", "of path", "live ATE", "recall %", "maps", "losses", "s/frame", "fps", "ms a stage", "peak MB")
PEER_HEADER = "best peer"


def table(report: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Header and rows; several seeds' values follow the median in brackets."""
    with_peers = bool(report["peers"])
    rows = [_row(s) + ([_peer(report["peers"].get(s["recording"]), s)] if with_peers else []) for s in report["results"]]
    return [*HEADER, *([PEER_HEADER] if with_peers else [])], rows


def markdown(report: Mapping[str, Any]) -> str:
    """A GitHub table, a line that explains it, and the failures."""
    header, rows = table(report)
    lines = [header, ["---"] * len(header), *rows]
    text = "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in lines)
    compared = "".join(f"\n{sentence}\n" for sentence in sentences(report["comparisons"]))
    return f"{text}\n{caption(report)}\n{compared}" + "".join(f"\nFailed: {failure}\n" for failure in failures(report))


def caption(report: Mapping[str, Any]) -> str:
    """What the columns mean."""
    runs = report["runs"]
    seeds = f"Median of {runs} runs with seeds 0 to {runs - 1}, each in brackets. " if runs > 1 else "Seed 0. "
    settings = f"With {', '.join(report['assignments'])}. " if report["assignments"] else ""
    peers = f" Best peer: the lowest median ATE among systems and variants that track at least {PEER_COVERAGE_PCT:g} %." if report["peers"] else ""
    shared = f" {report['workers']} runs at a time: times are those of a shared machine." if report["workers"] > 1 else ""
    return (
        f"{seeds}{settings}Tracked: frames of the main map outside shutter closures; ATE after Sim(3) alignment, in the reference's unit, and over its "
        f"spread (near 75 %: nothing was estimated) and the reference's path; no error where under {MIN_COVERAGE_PCT:g} % are tracked. Live: as estimated at the time. "
        f"Recall: frames within 1 % of the path. Time: median / 95 % of the first run, without the final adjustment; memory: the most of any run (a run from the cache loads no network).{peers}{shared} "
        f"Thegra {report['version']}, {described(report['machine'])}."
    )


def failures(report: Mapping[str, Any]) -> list[str]:
    """One line for each run that failed."""
    return [
        f"{s['recording']}, {s['profile']}, seed {f['seed']} (exit code {f['exit_code']}): {' '.join(f['error'].split())}"
        for s in report["results"]
        for f in s["failed"]
    ]


def _row(s: Mapping[str, Any]) -> list[str]:
    name = s["recording"] if s["max_frames"] is None else f"{s['recording']} (first {s['max_frames']})"
    if s["truth"] is None:
        return [name, s["profile"], "failed", *["–"] * (len(HEADER) - 3)]
    moving = s["truth"] == "moving"
    path, live, recall = (_median(s[key], form) if moving else "–" for key, form in (("ate_pct", "{:.2g} %"), ("ate_live_rmse", "{:.3g}"), ("recall_1pct", "{:.1f}")))
    fps = f"{s['fps']:.2g}" if s["fps"] else "–"
    return [
        name, s["profile"], _tracked(s), _error(s), _relative(s), path, live, recall, _each(s["maps"]), _each(s["losses"]), _time(s), fps, _stages(s), f"{s['peak_mb']:.0f}",
    ]  # fmt: skip


def _tracked(s: Mapping[str, Any]) -> str:
    claimed = sum(n for n in s["in_closure"] if n)
    return _median(s["tracked_pct"], "{:.1f}") + (f"; {claimed} poses in closures" if claimed else "")


def _error(s: Mapping[str, Any]) -> str:
    if s["truth"] == "moving":
        return _median(s["ate_rmse"], "{:.3g}")
    reason = "no ground truth" if s["truth"] == "none" else "does not move"
    poses = [n for n in s["poses"] if n is not None]
    claimed = f"{max(poses)} poses, extent {max(e for e in s['extent'] if e is not None):.2g}" if any(poses) else "no pose claimed"
    return f"{reason}: {claimed}"


def _relative(s: Mapping[str, Any]) -> str:
    median = s["ate_rel"]["median"]
    return f"{100 * median:.2g} %" if median is not None and s["truth"] == "moving" else "–"


def _time(s: Mapping[str, Any]) -> str:
    p50, p95 = s["s_per_frame"]["p50"], s["s_per_frame"]["p95"]
    if p50 is None:
        return "–"
    cached = f" ({s['cached_pct']:.0f} % cached)" if s["cached_pct"] else ""
    return f"{p50:.2g} / {p95:.2g}{cached}"


def _stages(s: Mapping[str, Any]) -> str:
    """Median of each stage that takes a millisecond, without the total."""
    shown = {stage: ms for stage, ms in (s["ms_stages"] or {}).items() if stage != "total" and ms is not None and ms >= 1}
    return ", ".join(f"{stage} {ms:.0f}" for stage, ms in shown.items()) or "–"


def _peer(best: Mapping[str, Any] | None, s: Mapping[str, Any]) -> str:
    if s["truth"] != "moving":
        return "–"
    if best is None:
        return f"none tracks {PEER_COVERAGE_PCT:g} %"
    spread = f" ({100 * best['ate_rmse'] / s['spread']:.2g} % of spread)" if s["spread"] and s["max_frames"] is None else ""
    frames = "" if s["max_frames"] is None else ", all frames"
    return f"{best['peer']} {best['variant']}: {best['tracked_pct']:.0f} % at {best['ate_rmse']:.3g}{spread}{frames}"


def _median(figure: Mapping[str, Any], form: str) -> str:
    values = [form.format(v) if v is not None else "–" for v in figure["seeds"]]
    median = form.format(figure["median"]) if figure["median"] is not None else "–"
    return median if len(values) == 1 or set(values) == {median} else f"{median} ({', '.join(values)})"


def _each(values: Sequence[int | None]) -> str:
    texts = ["–" if v is None else str(v) for v in values]
    return texts[0] if len(set(texts)) == 1 else ", ".join(texts)
