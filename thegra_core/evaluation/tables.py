"""Results of an evaluation in the form of the paper's Tables I and II: published figures and ours side by side."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from thegra_core.evaluation.evaluate import Result, failed
from thegra_core.evaluation.published import NOT_TOLD, SYSTEMS, TABLES, Cell
from thegra_core.outputs.scoring import MIN_COVERAGE_PCT

DASH = "-"
_NOTHING = Cell(NOT_TOLD, NOT_TOLD)


@dataclass(frozen=True, slots=True)
class Line:
    """One sequence of the paper with one profile, over all its pieces and seeds.

    failures: runs that ended with an error or tracked under half. The median ATE counts them as the worst, the mean leaves them out. None: not told.
    """

    row: str
    profile: str
    runs: int
    failures: int
    tracked_pct: float | None
    ate_median: float | None
    ate_quartiles: tuple[float | None, float | None]
    ate_mean: float | None
    ate_rel: float | None
    pairs_pct: float | None
    ate_fitted: float | None


def lines_of(results: Sequence[Result]) -> list[Line]:
    """One line for each row and profile, in the order of the results."""
    groups: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        groups.setdefault((result.job.sequence.row or result.job.sequence.name, result.job.profile), []).append(result)
    return [_line(row, profile, group) for (row, profile), group in groups.items()]


def table(dataset: str, lines: Sequence[Line], rows: Sequence[str]) -> tuple[list[str], list[list[str]]]:
    """Header and cells for people; `rows` are those that were looked for, so that what is missing shows, too."""
    published = TABLES.get(dataset, {})
    ours = ("profile", "ATE median (quartiles)", "ATE mean", "of spread", "tracked %", "scored %", "failed")
    header = ["sequence", *(SYSTEMS if published else ()), *ours]
    cells = []
    for row in rows:
        theirs = [_cell(c) for c in published.get(row, (_NOTHING,) * 4)] if published else []
        mine = [line for line in lines if line.row == row]
        cells += [[row, *theirs, *_ours(line)] for line in mine] or [[row, *theirs, "not here", *[DASH] * (len(ours) - 1)]]
    return header, cells


def table_csv(dataset: str, lines: Sequence[Line], rows: Sequence[str]) -> str:
    """The table for programs: one column a figure, unknown ones empty."""
    published = TABLES.get(dataset, {})
    names = [f"{system} {what}" for system in SYSTEMS for what in ("ATE", "tracked %")] if published else []
    columns = ("profile", "runs", "failures", "tracked_pct", "ate_median", "ate_q25", "ate_q75", "ate_mean", "ate_over_spread", "pairs_pct", "ate_fitted")
    content: list[list[Any]] = [["sequence", *names, *columns]]
    for row in rows:
        theirs = [value.replace(NOT_TOLD, "") for cell in published.get(row, (_NOTHING,) * 4) for value in cell] if published else []
        for line in [line for line in lines if line.row == row]:
            mine = [line.profile, line.runs, line.failures, line.tracked_pct, line.ate_median, *line.ate_quartiles, line.ate_mean, line.ate_rel, line.pairs_pct, line.ate_fitted]
            content.append([row, *theirs, *mine])
        if not any(line.row == row for line in lines):
            content.append([row, *theirs, *[""] * len(columns)])
    return _csv(content)


def runs_csv(results: Sequence[Result]) -> str:
    """Every run with all its figures."""
    figures = list(dict.fromkeys(key for result in results for key in result.figures))
    content: list[list[Any]] = [["sequence", "piece", "profile", "seed", "exit_code", *figures, "error"]]
    for r in results:
        job = r.job
        values = [" ".join(f"{v:.6g}" for v in x) if isinstance(x, list) else x for x in (r.figures.get(key) for key in figures)]
        content.append([job.sequence.row or job.sequence.name, job.sequence.name, job.profile, job.seed, r.outcome.exit_code, *values, " ".join((r.outcome.error or "").split())])
    return _csv(content)


def markdown(header: Sequence[str], cells: Sequence[Sequence[str]], caption: str, notes: Mapping[str, Sequence[str]], missing: Sequence[str], errors: Sequence[str]) -> str:
    """A GitHub table, what its columns mean, what was decided for each sequence, and what is missing or failed."""
    body = [list(header), ["---"] * len(header), *cells]
    text = "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in body) + f"\n{caption}\n"
    for title, entries in (
        ("Sequences", [f"{name}: {'; '.join(told)}" for name, told in notes.items()]), ("Missing", missing), ("Failed", errors),
    ):  # fmt: skip
        if entries:
            text += f"\n## {title}\n\n" + "".join(f"- {' '.join(entry.split())}\n" for entry in entries)
    return text


def caption(dataset: str, runs: int) -> str:
    """What the columns mean."""
    seeds = f"{runs} runs each, seeds 0 to {runs - 1}" if runs > 1 else "one run each, seed 0"
    paper = "" if dataset not in TABLES else (
        " Published: ATE in metres at the share of tracked frames, from arXiv 2602.08531; there ROTIO keeps its own scale, the others are aligned with one. "
        "Its text says too little to repeat its association of stamps."
    )  # fmt: skip
    return (
        f"Ours: {seeds}; over all pieces and seeds of a sequence. ATE in metres, RMSE after Sim(3) alignment to the reference, interpolated in gaps up to 0.5 s. "
        f"The median counts failed runs (an error, or under {MIN_COVERAGE_PCT:g} % tracked) as the worst, the mean leaves them out. Of spread: ATE over the RMS "
        f"spread of the scored part of the reference; near 75 %: nothing was estimated. Scored: frames with pose and reference.{paper}"
    )


def failures(results: Sequence[Result]) -> list[str]:
    """One line for each run that ended with an error."""
    return [f"{r.job.task.name} (exit code {r.outcome.exit_code}): {' '.join(r.outcome.error.split())}" for r in results if r.outcome.error is not None]


def _line(row: str, profile: str, group: Sequence[Result]) -> Line:
    ran = [r.figures for r in group if r.figures]
    errors = [np.inf if failed(r) or r.figures["ate_rmse"] is None else float(r.figures["ate_rmse"]) for r in group]
    scored = any(f["ate_rmse"] is not None for f in ran)
    told = [e for e in errors if np.isfinite(e)]
    return Line(
        row=row,
        profile=profile,
        runs=len(group),
        failures=sum(failed(r) for r in group),
        tracked_pct=_median([r.figures.get("tracked_pct", 0.0) for r in group]),
        ate_median=_quantile(errors, 0.5) if scored else None,
        ate_quartiles=(_quantile(errors, 0.25), _quantile(errors, 0.75)) if scored else (None, None),
        ate_mean=float(np.mean(told)) if told else None,
        ate_rel=_median([f["ate_rel"] for f in ran]),
        pairs_pct=_median([f["ate_pairs_pct"] for f in ran]),
        ate_fitted=_median([f.get("ate_fitted") for f in ran]),
    )


def _ours(line: Line) -> list[str]:
    low, high = line.ate_quartiles
    spread = f" ({_number(low)} to {_number(high)})" if line.runs > 1 and line.ate_median is not None else ""
    fitted = f"; fitted {line.ate_fitted:.3g}" if line.ate_fitted is not None else ""
    return [
        line.profile, f"{_number(line.ate_median)}{spread}{fitted}", _number(line.ate_mean), DASH if line.ate_rel is None else f"{100 * line.ate_rel:.2g} %",
        DASH if line.tracked_pct is None else f"{line.tracked_pct:.1f}", DASH if line.pairs_pct is None else f"{line.pairs_pct:.1f}", f"{line.failures} of {line.runs}",
    ]  # fmt: skip


def _cell(cell: Cell) -> str:
    if cell.ate == NOT_TOLD:
        return DASH if cell.tracked == NOT_TOLD else f"{DASH} at {cell.tracked} %"
    return f"{cell.ate} at {cell.tracked} %"


def _number(value: float | None) -> str:
    return DASH if value is None else f"{value:.3g}"


def _quantile(values: Sequence[float], share: float) -> float | None:
    """None where it is infinite: a value of the sorted ones, since between a number and a failure there is nothing."""
    value = float(np.quantile(values, share, method="linear" if np.all(np.isfinite(values)) else "higher"))
    return value if np.isfinite(value) else None


def _median(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.median(known)) if known else None


def _csv(content: Sequence[Sequence[Any]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([["" if cell is None else f"{cell:.6g}" if isinstance(cell, float) else cell for cell in line] for line in content])
    return text.getvalue()
