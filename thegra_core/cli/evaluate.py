"""`thegra evaluate`: a public data set through the system, beside published figures."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from thegra_core.errors import ConfigError, InputError
from thegra_core.evaluation import tables
from thegra_core.evaluation.datasets.registry import DATASETS
from thegra_core.evaluation.datasets.sequence import Found, Options, Pieces, ReferenceChoice
from thegra_core.evaluation.evaluate import Job, Plan, Result, missing_lines, plan_jobs, run_jobs, sequence_notes
from thegra_core.evaluation.published import TABLES
from thegra_core.evaluation.scores import Settings
from thegra_core.evaluation.tasks import Outcome
from thegra_core.outputs.files import write_atomic, writing_to
from thegra_core.version import VERSION

SOME_FAILED = 1


@dataclass(frozen=True, slots=True)
class EvaluateOptions:
    """The command's options."""

    dataset: str
    folders: tuple[Path, ...]
    out: Path
    runs: int = 1
    profiles: tuple[str, ...] = ("quality",)
    workers: int = 1
    dask: str | None = None
    pieces: Pieces = "bags"
    reference: ReferenceChoice = "auto"
    camera: str | None = None
    only: tuple[str, ...] = ()
    max_frames: int | None = None
    cache: Path | None = None
    assignments: tuple[str, ...] = ()
    fits: Settings = field(default_factory=Settings)
    dry_run: bool = False


def evaluate(options: EvaluateOptions) -> int:
    """Find, run, score, write and print.

    Returns:
        The exit code: 0 all ran, 1 some run failed.

    Raises:
        ThegraError: If an option cannot be used or nothing of the data set is there.
    """
    options = absolute(options)
    found = find(options)
    plan = Plan(options.dataset, found, options.out, options.profiles, options.runs, options.assignments, options.cache, options.max_frames, options.fits)
    _say_missing(found)
    jobs = plan_jobs(plan)
    notes = sequence_notes(plan, jobs)
    _say_notes(notes)
    if options.dry_run:
        return 0
    results = _run(jobs, plan, options)
    content = write(plan, results, notes, options)
    _show(content, options.out)
    return SOME_FAILED if any(result.outcome.error is not None for result in results) else 0


def find(options: EvaluateOptions) -> Found:
    """The sequences that were asked for.

    Raises:
        ConfigError: If the data set is unknown, or --only names no sequence.
        InputError: If nothing is there.
    """
    if options.dataset not in DATASETS:
        raise ConfigError(f"--dataset {options.dataset} is unknown; known: {', '.join(DATASETS)}")
    absent = next((folder for folder in options.folders if not folder.exists()), None)
    if absent is not None:
        raise InputError(f"{absent} does not exist; give the folder that holds the data set")
    found = DATASETS[options.dataset](options.folders, Options(options.out / "inputs", options.pieces, reference=options.reference, camera=options.camera))
    if not options.only:
        return found
    names = {name for s in found.sequences for name in (s.name, s.row)} | {m.name for m in found.missing}
    unknown = [name for name in options.only if name not in names]
    if unknown:
        raise ConfigError(f"--only {unknown[0]}: there is no such sequence; there are {', '.join(sorted(names))}")
    chosen = tuple(s for s in found.sequences if s.name in options.only or s.row in options.only)
    return Found(chosen, tuple(m for m in found.missing if m.name in options.only))


def absolute(options: EvaluateOptions) -> EvaluateOptions:
    """Paths that mean the same wherever a worker runs."""
    camera = options.camera
    if camera is not None:
        head, mark, tail = camera.rpartition(":")
        camera = f"{Path(head).absolute()}{mark}{tail}" if head and not Path(camera).exists() else str(Path(camera).absolute())
    cache = None if options.cache is None else options.cache.absolute()
    return replace(options, folders=tuple(f.absolute() for f in options.folders), out=options.out.absolute(), camera=camera, cache=cache)


def write(plan: Plan, results: Sequence[Result], notes: dict[str, list[str]], options: EvaluateOptions) -> dict[str, Any]:
    """results.json, results.md, table.csv and runs.csv in the plan's folder; returns what results.json holds.

    Raises:
        InputError: If they cannot be written.
    """
    lines = tables.lines_of(results)
    rows = _rows(plan, lines, options)
    header, cells = tables.table(plan.dataset, lines, rows)
    caption, missing, errors = tables.caption(plan.dataset, plan.runs), missing_lines(plan.found.missing), tables.failures(results)
    content = {
        "version": VERSION, "dataset": plan.dataset, "pieces": options.pieces, "runs": plan.runs, "profiles": list(plan.profiles), "assignments": list(plan.assignments),
        "table": [asdict(line) for line in lines], "published": {row: [c._asdict() for c in cells_] for row, cells_ in TABLES.get(plan.dataset, {}).items()},
        "results": [
            {"sequence": r.job.sequence.row or r.job.sequence.name, "piece": r.job.sequence.name, "profile": r.job.profile, "seed": r.job.seed, "folder": str(r.job.task.folder),
             "exit_code": r.outcome.exit_code, "error": r.outcome.error} | dict(r.figures) for r in results
        ],
        "notes": notes, "missing": missing, "failed": errors, "caption": caption, "header": header, "cells": cells,
    }  # fmt: skip
    with writing_to(plan.out):
        write_atomic(plan.out / "results.json", json.dumps(content, indent=2, allow_nan=False) + "\n")
        write_atomic(plan.out / "results.md", tables.markdown(header, cells, caption, notes, missing, errors))
        write_atomic(plan.out / "table.csv", tables.table_csv(plan.dataset, lines, rows))
        write_atomic(plan.out / "runs.csv", tables.runs_csv(results))
    return content


def _rows(plan: Plan, lines: Sequence[tables.Line], options: EvaluateOptions) -> list[str]:
    """The paper's rows in its order, then others."""
    ran = dict.fromkeys(line.row for line in lines)
    paper = [row for row in TABLES.get(plan.dataset, {}) if not options.only or row in ran or any(m.name == row for m in plan.found.missing)]
    return [*paper, *(row for row in ran if row not in paper)]


def _run(jobs: Sequence[Job], plan: Plan, options: EvaluateOptions) -> list[Result]:
    with progress_of(jobs) as told:
        return run_jobs(jobs, plan, told, options.workers, options.dask)


@contextmanager
def progress_of(jobs: Sequence[Job]) -> Iterator[Callable[[int, Outcome], None]]:
    """A bar on stderr, and above it a line for each job that is done; yields what tells it."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(bar_width=20), MofNCompleteColumn(), TimeElapsedColumn())
    console = Console(stderr=True, highlight=False)
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("running", total=len(jobs))

        def told(place: int, outcome: Outcome) -> None:
            state = f"failed: {outcome.error}" if outcome.error else f"{outcome.metrics.get('tracked_pct', 0):g} % tracked{', run before' if outcome.resumed else ''}"
            console.print(f"{jobs[place].task.name}: {state}", markup=False, soft_wrap=True)
            bar.advance(task)

        yield told


def _say_missing(found: Found) -> None:
    import typer

    for line in missing_lines(found.missing):
        typer.echo(f"missing: {line}", err=True)


def _say_notes(notes: dict[str, list[str]]) -> None:
    import typer

    for name, told in notes.items():
        typer.echo(f"{name}: {'; '.join(told)}", err=True)


def _show(content: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    shown = Table(caption=escape(content["caption"]), caption_justify="left")
    for name in content["header"]:
        shown.add_column(name, overflow="fold")
    for row in content["cells"]:
        shown.add_row(*map(escape, row))
    console = Console(highlight=False)
    console.print(shown)
    for name in ("results.md", "table.csv", "runs.csv", "results.json"):
        console.print(str(out / name), soft_wrap=True, markup=False)
