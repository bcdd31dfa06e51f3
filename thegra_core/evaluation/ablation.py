"""What single choices are worth: the paper's Table III (weights of the observations) with errors beside coverage, and filters against the error."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from thegra_core.evaluation.datasets.sequence import DataSequence, Found, Reference
from thegra_core.evaluation.evaluate import Job, Plan, Result, failed, figures_of, plan_jobs
from thegra_core.evaluation.published import WEIGHTING
from thegra_core.evaluation.study.variants import CHAINS
from thegra_core.evaluation.workers import Runner, Told, run_tasks
from thegra_core.outputs.trajectory import read_tum
from thegra_core.sources.open import open_recording

Group = Literal["weighting", "chain"]
GROUPS: tuple[Group, ...] = get_args(Group)
WEIGHTINGS = ("uniform", "normalized", "paper")
ABLATED_CHAINS = (
    "stretch", "HE", "HE + median", "CLAHE + median", "band-pass + HE + median", "bilateral + HE + median", "Chambolle + HE + median", "Chambolle by noise + HE + median",
)  # fmt: skip
HEADER = ("choice", "variant", "tracked until loss %", "tracked %", "ATE", "of spread %", "failed")
_FIGURES = ("tracked_until_loss_pct", "tracked_pct", "ate_rmse", "ate_rel", "ate_pairs", "ate_spread", "losses")


@dataclass(frozen=True, slots=True)
class Variant:
    """One choice: what it belongs to, its name, and the parameter that makes it."""

    group: Group
    name: str
    assignment: str


@dataclass(frozen=True, slots=True)
class AblationPlan:
    """Every variant on every sequence with the seeds 0 to runs - 1; all variants share the networks' results in `cache`."""

    sequences: tuple[DataSequence, ...]
    out: Path
    cache: Path
    variants: tuple[Variant, ...]
    profile: str = "quality"
    runs: int = 1
    assignments: tuple[str, ...] = ()
    max_frames: int | None = None


@dataclass(frozen=True, slots=True)
class Row:
    """One run of a variant."""

    variant: Variant
    result: Result


def variants_of(groups: Sequence[Group]) -> tuple[Variant, ...]:
    """The variants of some groups."""
    weighting = [Variant("weighting", name, f"weighting={name}") for name in WEIGHTINGS]
    chains = [Variant("chain", name, f"preprocessing.filters={json.dumps([f.model_dump() for f in CHAINS[name].filters])}") for name in ABLATED_CHAINS]
    return tuple(variant for variant in [*weighting, *chains] if variant.group in groups)


def sequences_of(recordings: Sequence[Path], camera: str | None) -> tuple[DataSequence, ...]:
    """Recordings as sequences, scored against the ground truth beside them.

    Raises:
        InputError: If one cannot be opened.
    """
    return tuple(_sequence(path, camera) for path in recordings)


def run_ablation(plan: AblationPlan, told: Told, workers: int = 1, dask: str | None = None, runner: Runner | None = None) -> list[Row]:
    """Every run, in the order variant, sequence, seed.

    Raises:
        ThegraError: If something cannot be used, before anything runs.
    """
    planned = planned_jobs(plan)
    options: dict[str, Any] = {} if runner is None else {"runner": runner}
    outcomes = run_tasks([job.task for _, _, job in planned], told, workers, dask, **options)
    return [Row(variant, Result(job, outcome, figures_of(job, outcome, part.fits))) for (variant, part, job), outcome in zip(planned, outcomes, strict=True)]


def planned_jobs(plan: AblationPlan) -> list[tuple[Variant, Plan, Job]]:
    """Every run with its variant and the evaluation it is part of."""
    parts = [
        (v, Plan("ablation", Found(plan.sequences), plan.out / "runs" / v.group / _slug(v.name), (plan.profile,), plan.runs, (*plan.assignments, v.assignment), plan.cache, plan.max_frames))
        for v in plan.variants
    ]
    return [(variant, part, job) for variant, part in parts for job in plan_jobs(part)]


def summary(rows: Sequence[Row]) -> list[list[str]]:
    """A line a variant: median / interquartile range over sequences and seeds. Runs that failed count as 0 % tracked, and have no error."""
    lines = []
    for variant in dict.fromkeys(row.variant for row in rows):
        results = [row.result for row in rows if row.variant == variant]
        ran = [r.figures for r in results if r.figures]
        errors = [[f[key] for f in ran if f[key] is not None] for key in ("ate_rmse", "ate_rel")]
        lines.append([
            variant.group, variant.name, *(_spread([r.figures.get(key, 0.0) for r in results]) for key in ("tracked_until_loss_pct", "tracked_pct")),
            _spread(errors[0]), _spread([100 * e for e in errors[1]]), f"{sum(failed(r) for r in results)} of {len(results)}",
        ])  # fmt: skip
    return lines


def to_csv(rows: Sequence[Row]) -> str:
    """Every run."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["choice", "variant", "sequence", "seed", *_FIGURES, "error"])
    for row in rows:
        figures, job = row.result.figures, row.result.job
        values = [figures.get(key) for key in _FIGURES]
        error = " ".join((row.result.outcome.error or "").split())
        writer.writerow([row.variant.group, row.variant.name, job.sequence.name, job.seed, *("" if v is None else f"{v:.6g}" for v in values), error])
    return text.getvalue()


def markdown(rows: Sequence[Row], plan: AblationPlan) -> str:
    """GitHub tables and what their columns mean, with the paper's Table III."""
    body = [list(HEADER), ["---"] * len(HEADER), *summary(rows)]
    text = "".join("| " + " | ".join(line) + " |\n" for line in body)
    paper = "; ".join(f"{name} {rovtio} on ROVTIO, {vivid} on ViViD++" for name, (rovtio, vivid) in WEIGHTING.items())
    return f"{text}\n{caption(plan)}\n\nThe paper's Table III, tracked until loss, median/IQR in per cent: {paper}.\n"


def caption(plan: AblationPlan) -> str:
    """What the columns mean."""
    return (
        f"Median / interquartile range over {len(plan.sequences)} sequences and {plan.runs} seeds, profile {plan.profile}. Tracked until loss: frames with a pose before tracking was "
        "lost for the first time. ATE after Sim(3) alignment, of the runs that track at least half; a run that follows more of a hard sequence may have the larger error, so read both."
    )


def _sequence(path: Path, camera: str | None) -> DataSequence:
    recording = open_recording(path)
    truth = recording.groundtruth

    def reference(file: Path) -> Reference:
        return Reference(read_tum(file), f"{file}")

    return DataSequence(path.resolve().name, path.absolute(), None, camera, None if truth is None else lambda: reference(truth.absolute()))


def _slug(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def _spread(values: Sequence[float]) -> str:
    if not values:
        return "-"
    low, middle, high = (float(np.quantile(values, share)) for share in (0.25, 0.5, 0.75))
    return f"{middle:.3g} / {high - low:.2g}"
