"""A data set from end to end: its sequences with every profile and seed, scored, in the paper's tables beside the published figures."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from thegra_core.config import load_config, parse_assignments
from thegra_core.errors import InputError
from thegra_core.evaluation.datasets.sequence import DataSequence, Found, Missing
from thegra_core.evaluation.scores import Settings, score_fitted
from thegra_core.evaluation.tasks import Outcome, RunTask, fingerprint
from thegra_core.evaluation.workers import Runner, Told, run_tasks
from thegra_core.outputs.files import write_atomic, writing_to
from thegra_core.outputs.scoring import MIN_COVERAGE_PCT
from thegra_core.outputs.trajectory import format_tum, read_tum

FIGURES = (
    "frames_total", "tracked_pct", "tracked_until_loss_pct", "losses", "maps", "keyframes", "loops", "ate_rmse", "ate_live_rmse", "ate_rel", "ate_pct", "ate_scale",
    "ate_pairs", "ate_pairs_pct", "ate_time_pct", "ate_path", "ate_spread", "recall_1pct", "rot_deg", "path_length", "fps", "peak_rss_mb",
)  # fmt: skip
"""Keys of `metrics.json` that are taken over for each run."""
ERRORS = ("ate_rmse", "ate_live_rmse", "ate_rel", "ate_pct", "rot_deg", "ate_fitted")
"""Figures that are None where too few frames have a pose."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What to run of what was found; max_frames None: all. `fits` says what of the reference to fit for a second ATE."""

    dataset: str
    found: Found
    out: Path
    profiles: tuple[str, ...] = ("quality",)
    runs: int = 1
    assignments: tuple[str, ...] = ()
    cache: Path | None = None
    max_frames: int | None = None
    fits: Settings = field(default_factory=Settings)


@dataclass(frozen=True, slots=True)
class Job:
    """One run of the plan."""

    sequence: DataSequence
    profile: str
    seed: int
    task: RunTask
    reference: str


@dataclass(frozen=True, slots=True)
class Result:
    """A job and how it ended; figures are empty where it failed."""

    job: Job
    outcome: Outcome
    figures: Mapping[str, Any]


def plan_jobs(plan: Plan) -> list[Job]:
    """Every run in order: sequence, then profile, then seed. Reads the references and keeps each as `groundtruth.txt` in the sequence's folder.

    Raises:
        InputError: If a folder cannot be written.
        ConfigError: If a profile or an assignment is not understood.
    """
    for profile in plan.profiles:
        load_config(profile, None, parse_assignments(plan.assignments))
    jobs = []
    for sequence in plan.found.sequences:
        truth, told = _reference(sequence, plan.out / sequence.name)
        for profile in plan.profiles:
            for seed in range(plan.runs):
                folder = plan.out / sequence.name / profile / f"seed{seed}"
                task = RunTask(f"{sequence.name} {profile} seed {seed}", sequence.recording, folder, _options(sequence, profile, seed, plan), truth, plan.cache)
                jobs.append(Job(sequence, profile, seed, task, told))
    return jobs


def run_jobs(jobs: Sequence[Job], plan: Plan, told: Told, workers: int = 1, dask: str | None = None, runner: Runner | None = None) -> list[Result]:
    """Results of all jobs in their order; see `run_tasks`."""
    options = {} if runner is None else {"runner": runner}
    outcomes = run_tasks([job.task for job in jobs], told, workers, dask, **options)
    return [Result(job, outcome, figures_of(job, outcome, plan.fits)) for job, outcome in zip(jobs, outcomes, strict=True)]


def figures_of(job: Job, outcome: Outcome, fits: Settings) -> dict[str, Any]:
    """Figures of a finished run; the errors are None where too few frames have a pose. Empty where it failed."""
    if not outcome.metrics:
        return {}
    figures: dict[str, Any] = {key: outcome.metrics.get(key) for key in FIGURES}
    if fits.fit_lever_arm or fits.fit_time_offset:
        figures |= _fitted(job, fits)
    if figures["tracked_pct"] < MIN_COVERAGE_PCT:
        figures |= {key: None for key in ERRORS if key in figures}
    return figures


def failed(result: Result) -> bool:
    """Whether a run ended with an error or tracked too little to be scored."""
    return not result.figures or result.figures["tracked_pct"] < MIN_COVERAGE_PCT


def sequence_notes(plan: Plan, jobs: Sequence[Job]) -> dict[str, list[str]]:
    """What was decided for each sequence: topic, camera, reference."""
    told = {job.sequence.name: job.reference for job in jobs}
    return {s.name: [*s.notes, *([told[s.name]] if told.get(s.name) else [])] for s in plan.found.sequences}


def missing_lines(missing: Sequence[Missing]) -> list[str]:
    """One line for each sequence that is not there."""
    return [f"{m.name}: {m.how_to_get}" for m in missing]


def _options(sequence: DataSequence, profile: str, seed: int, plan: Plan) -> tuple[str, ...]:
    words: list[object] = ["--profile", profile, "--seed", seed]
    words += ["--topic", sequence.topic] if sequence.topic else []
    words += ["--camera", sequence.camera] if sequence.camera else []
    words += ["--start", sequence.start_s] if sequence.start_s else []
    words += ["--duration", sequence.duration_s] if sequence.duration_s is not None else []
    words += ["--max-frames", plan.max_frames] if plan.max_frames is not None else []
    words += [word for assignment in plan.assignments for word in ("--set", assignment)]
    return tuple(map(str, words))


def _reference(sequence: DataSequence, folder: Path) -> tuple[Path | None, str]:
    """The reference as a TUM file, made once, and what it is; a reference that cannot be read is told and costs only the scores."""
    if sequence.reference is None:
        return None, ""
    file, facts = folder / "groundtruth.txt", folder / "groundtruth.json"
    key = [*map(fingerprint, (sequence.recording, *sequence.reference_files)), *sequence.notes]
    try:
        known = json.loads(facts.read_text(encoding="utf-8"))
        if known["key"] == key and file.is_file():
            return file, str(known["source"])
    except (OSError, ValueError, KeyError):
        pass
    try:
        reference = sequence.reference()
    except InputError as error:
        return None, f"no ground truth: {error}"
    with writing_to(folder):
        write_atomic(file, f"# {reference.source}\n{format_tum(reference.trajectory)}")
        write_atomic(facts, json.dumps({"key": key, "source": reference.source}, indent=2) + "\n")
    return file, reference.source


def _fitted(job: Job, fits: Settings) -> dict[str, Any]:
    """A second ATE with what was asked for fitted, over the frames that have a pose."""
    file = job.task.folder / "trajectory.txt"
    if job.task.groundtruth is None or not file.is_file():
        return {"ate_fitted": None}
    estimate, truth = read_tum(file), read_tum(job.task.groundtruth)
    if len(estimate) == 0:
        return {"ate_fitted": None}
    fitted = score_fitted(estimate, truth, estimate.stamps_ns, (), fits).as_dict()
    return {"ate_fitted": fitted["ate_rmse"]} | {k: v for k, v in fitted.items() if k.startswith(("time_offset", "lever_arm"))}
