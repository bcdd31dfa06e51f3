"""`thegra ablation`: what the weights of the observations and the filters are worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from thegra_core.cli.evaluate import EvaluateOptions, absolute, find, progress_of
from thegra_core.errors import InputError
from thegra_core.evaluation import ablation as logic
from thegra_core.evaluation.ablation import AblationPlan, Group, Row
from thegra_core.evaluation.datasets.sequence import DataSequence
from thegra_core.outputs.files import write_atomic, writing_to

SOME_FAILED = 1


@dataclass(frozen=True, slots=True)
class AblationOptions:
    """The command's options."""

    inputs: tuple[Path, ...]
    out: Path
    dataset: str | None = None
    groups: tuple[Group, ...] = logic.GROUPS
    profile: str = "quality"
    runs: int = 1
    workers: int = 1
    dask: str | None = None
    camera: str | None = None
    cache: Path | None = None
    max_frames: int | None = None
    assignments: tuple[str, ...] = ()


def ablation(options: AblationOptions) -> int:
    """Run every variant, write table, CSV and pictures, and print.

    Returns:
        The exit code: 0 all ran, 1 some run failed.

    Raises:
        ThegraError: If something cannot be used.
    """
    places = absolute(EvaluateOptions(options.dataset or "", options.inputs, options.out, camera=options.camera, cache=options.cache))
    plan = AblationPlan(
        _sequences(places), places.out, places.cache or places.out / "cache", logic.variants_of(options.groups), options.profile, options.runs, options.assignments, options.max_frames
    )
    jobs = [job for _, _, job in logic.planned_jobs(plan)]
    with progress_of(jobs) as told:
        rows = logic.run_ablation(plan, told, options.workers, options.dask)
    files = write(plan, rows)
    _show(plan, rows, files)
    return SOME_FAILED if any(row.result.outcome.error is not None for row in rows) else 0


def write(plan: AblationPlan, rows: Sequence[Row]) -> list[Path]:
    """ablation.md, ablation.csv and a box plot a group.

    Raises:
        InputError: If they cannot be written.
    """
    from thegra_core.evaluation.ablation_figures import box_plots

    with writing_to(plan.out):
        files = [write_atomic(plan.out / "ablation.md", logic.markdown(rows, plan)), write_atomic(plan.out / "ablation.csv", logic.to_csv(rows))]
        for group in dict.fromkeys(variant.group for variant in plan.variants):
            mine = [row for row in rows if row.variant.group == group]
            files.append(write_atomic(plan.out / f"{group}.png", box_plots(mine, f"{group}, profile {plan.profile}")))
    return files


def _sequences(options: EvaluateOptions) -> tuple[DataSequence, ...]:
    if options.dataset:
        return find(options).sequences
    sequences = logic.sequences_of(options.folders, options.camera)
    names = sorted(s.name for s in sequences)
    if len(set(names)) < len(names):
        raise InputError(f"recordings need different names to tell their results apart, got {', '.join(names)}")
    return sequences


def _show(plan: AblationPlan, rows: Sequence[Row], files: Sequence[Path]) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    shown = Table(caption=escape(logic.caption(plan)), caption_justify="left")
    for name in logic.HEADER:
        shown.add_column(name, overflow="fold")
    for line in logic.summary(rows):
        shown.add_row(*map(escape, line))
    console = Console(highlight=False)
    console.print(shown)
    for file in files:
        console.print(str(file), soft_wrap=True, markup=False)
