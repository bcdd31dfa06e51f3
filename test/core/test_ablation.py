"""`thegra ablation` without networks, and its tables and pictures from known figures."""

from __future__ import annotations

import csv
import json
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from dataset_making import metrics
from typer.testing import CliRunner

from thegra_core.cli.main import app
from thegra_core.config import load_config
from thegra_core.evaluation import ablation
from thegra_core.evaluation.ablation import ABLATED_CHAINS, AblationPlan, Row, Variant, planned_jobs, run_ablation, sequences_of, summary, variants_of
from thegra_core.evaluation.evaluate import Result
from thegra_core.evaluation.study.variants import CHAINS
from thegra_core.evaluation.tasks import Outcome, RunTask
from thegra_core.simulation.simulate import SimulationOptions, simulate


def pretend(task: RunTask) -> Outcome:
    """Uniform weights lose the second seed early; anything else tracks all."""
    task.folder.mkdir(parents=True, exist_ok=True)
    lost = "weighting=uniform" in task.options and task.options[task.options.index("--seed") + 1] == "1"
    chosen = next(o for o in task.options if o.startswith(("weighting", "preprocessing")))
    if "bilateral" in chosen:
        return Outcome(2, error="thegra: out of memory")
    return Outcome(0, metrics(tracked_until_loss_pct=20.0 if lost else 100.0, tracked_pct=20.0 if lost else 100.0, ate_rmse=0.3, ate_rel=0.1))


def images(folder: Path, truth: bool = True) -> Path:
    folder.mkdir()
    for i in range(2):
        cv2.imwrite(str(folder / f"{i}.png"), np.zeros((8, 8), np.uint8))
    (folder / "images.txt").write_text("1.0 0.png\n2.0 1.png\n")
    if truth:
        (folder / "groundtruth.txt").write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    return folder


@pytest.fixture
def ran(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from thegra_core.cli import ablation as command

    monkeypatch.setattr(command.logic, "run_ablation", partial(run_ablation, runner=pretend))
    arguments = ["ablation", images(tmp_path / "a"), images(tmp_path / "b"), "--runs", 2, "--out", tmp_path / "out"]
    return CliRunner().invoke(app, list(map(str, arguments)), env={"COLUMNS": "200", "TERM": "dumb"})


def test_table_three_with_errors(ran, tmp_path: Path) -> None:
    assert ran.exit_code == 1, ran.output
    text = (tmp_path / "out" / "ablation.md").read_text()
    assert "| weighting | uniform | 60 / 80 | 60 / 80 | 0.3 / 0 | 10 / 0 | 2 of 4 |" in text
    assert "| weighting | paper | 100 / 0 | 100 / 0 | 0.3 / 0 | 10 / 0 | 0 of 4 |" in text
    assert "| chain | bilateral + HE + median | 0 / 0 | 0 / 0 | - | - | 4 of 4 |" in text
    assert "uniform 93.1/17 on ROVTIO, 100/75.7 on ViViD++" in text
    with (tmp_path / "out" / "ablation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == (3 + len(ABLATED_CHAINS)) * 2 * 2
    assert [(r["variant"], r["sequence"], r["seed"]) for r in rows[:4]] == [("uniform", name, seed) for name in "ab" for seed in "01"]
    assert rows[1]["ate_rmse"] == "" and rows[1]["tracked_until_loss_pct"] == "20"
    for name in ("weighting.png", "chain.png"):
        assert cv2.imread(str(tmp_path / "out" / name)).shape[0] > 100


def test_every_variant_is_a_configuration_and_shares_the_cache(tmp_path: Path) -> None:
    plan = AblationPlan(sequences_of([images(tmp_path / "a", truth=False)], None), tmp_path / "out", tmp_path / "cache", variants_of(("weighting", "chain")))
    jobs = planned_jobs(plan)
    assert len({job.task.folder for _, _, job in jobs}) == len(jobs) == 3 + len(ABLATED_CHAINS)
    for variant, _, job in jobs:
        key, _, value = variant.assignment.partition("=")
        config = load_config("quality", None, {key: value})
        if variant.group == "weighting":
            assert config.weighting == variant.name
        else:
            assert config.preprocessing.filters == CHAINS[variant.name].filters
        assert job.task.cache == tmp_path / "cache"
        assert job.task.groundtruth is None


def test_groups_can_be_chosen() -> None:
    assert {v.group for v in variants_of(("weighting",))} == {"weighting"}
    assert {v.group for v in variants_of(ablation.GROUPS)} == {"weighting", "chain"}


def test_failed_runs_count_as_untracked(tmp_path: Path) -> None:
    plan = AblationPlan(sequences_of([images(tmp_path / "a")], None), tmp_path / "out", tmp_path / "cache", (Variant("weighting", "paper", "weighting=paper"),))
    ((variant, _, job),) = planned_jobs(plan)
    good, bad = Result(job, Outcome(), metrics()), Result(job, Outcome(2, error="x"), {})
    assert summary([Row(variant, good), Row(variant, bad)])[0][2:] == ["50 / 50", "50 / 50", "0.1 / 0", "5 / 0", "1 of 2"]


def test_recordings_of_one_name_are_refused(tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    first, second = images(tmp_path / "a"), images(tmp_path / "x" / "a")
    done = CliRunner().invoke(app, ["ablation", str(first), str(second), "--out", str(tmp_path / "out")])
    assert done.exit_code == 2
    assert "different names" in done.stderr


@pytest.mark.slow
def test_weightings_share_what_the_networks_found(tmp_path: Path) -> None:
    folder = simulate(SimulationOptions(duration_s=2.4, rate_hz=5, image_size=(320, 256), seed=1, sensor={"netd_mk": 20}), tmp_path / "room", "folder")
    out = tmp_path / "out"
    arguments = ["ablation", folder, "--choice", "weighting", "--out", out, "--set", "extractor.name=orb", "--set", "preprocessing.filters=[{filter: he_clip}]"]
    assert CliRunner().invoke(app, list(map(str, arguments))).exit_code == 0
    cached = [json.loads((out / "runs" / "weighting" / name / "room" / "quality" / "seed0" / "metrics.json").read_text())["cached_pct"] for name in ("uniform", "normalized", "paper")]
    assert cached[0] < 60 < min(cached[1:])
