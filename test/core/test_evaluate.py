"""`thegra evaluate` without networks: plans, tables, workers that fail, and runs that are not done twice."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from bag_making import T0, write_ros1
from dataset_making import PERIOD_NS, metrics, odometry, pretend, thermal, walk
from typer.testing import CliRunner

from thegra_core.cli import evaluate as evaluate_command
from thegra_core.cli.main import app
from thegra_core.errors import ConfigError
from thegra_core.evaluation import tables, workers
from thegra_core.evaluation.datasets.rovtio import LOAM
from thegra_core.evaluation.datasets.sequence import DataSequence, Found
from thegra_core.evaluation.evaluate import Plan, Result, failed, figures_of, plan_jobs, run_jobs
from thegra_core.evaluation.published import ROVTIO, VIVID
from thegra_core.evaluation.scores import Settings
from thegra_core.evaluation.tasks import Outcome, RunTask, execute, finished
from thegra_core.evaluation.workers import run_tasks
from thegra_core.outputs.trajectory import Trajectory, format_tum, read_tum

TAU = "/tau_nodelet/thermal_image"


@pytest.fixture
def rovtio(tmp_path: Path) -> Path:
    """lt1 tracks too little, lt2 fails, lt3's worker dies, alt1 is in two pieces; alt2 and sync are missing."""
    root = tmp_path / "data"
    for name, bags in (("alt1", 2), ("lt1", 1), ("lt2", 1), ("lt3", 1)):
        (root / name).mkdir(parents=True)
        for i in range(bags):
            begin = T0 + i * 5 * PERIOD_NS
            write_ros1(root / name / f"m100_{i}.bag", thermal(TAU, 5, begin) + odometry(LOAM, walk(5, begin)))
    return root


@pytest.fixture
def evaluate(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """The command with the made runner, in a wide terminal."""
    monkeypatch.setattr(evaluate_command, "run_jobs", partial(run_jobs, runner=pretend))

    def go(*arguments: object):
        return CliRunner().invoke(app, ["evaluate", *map(str, arguments), "--out", str(tmp_path / "out")], env={"COLUMNS": "300", "TERM": "dumb"})

    return go


def test_table_one_with_its_failures(rovtio: Path, evaluate, tmp_path: Path) -> None:
    done = evaluate("--dataset", "rovtio", rovtio, "--runs", 3, "--profile", "fast", "--workers", 2)
    assert done.exit_code == 1, done.output
    out = tmp_path / "out"
    with (out / "table.csv").open() as file:
        lines = {row["sequence"]: row for row in csv.DictReader(file)}
    assert list(lines) == list(ROVTIO)
    assert lines["alt1"]["Thegra (paper) ATE"] == "0.14"
    assert lines["lt1"]["Thegra (paper) ATE"] == ""
    assert lines["lt1"]["Thegra (paper) tracked %"] == "98.75"
    assert (lines["alt1"]["runs"], lines["alt1"]["failures"]) == ("6", "0")  # two pieces, three seeds
    assert float(lines["alt1"]["ate_median"]) == pytest.approx(0.2)
    assert float(lines["alt1"]["ate_mean"]) == pytest.approx(0.2)
    assert [float(lines["alt1"][k]) for k in ("ate_q25", "ate_q75")] == [pytest.approx(0.125), pytest.approx(0.275)]
    assert (lines["lt1"]["failures"], lines["lt1"]["ate_median"], lines["lt1"]["tracked_pct"]) == ("3", "", "30")
    assert (lines["lt2"]["failures"], lines["lt2"]["tracked_pct"]) == ("3", "0")
    assert lines["alt2"]["profile"] == ""
    assert "missing: alt2: download alt2.zip" in done.stderr
    assert "lt2_00 fast seed 1: failed: thegra: no" in done.stderr
    text = (out / "results.md").read_text()
    assert "| alt1 | - at 93.06 % | 22.33 at 100 % | - at 92.38 % | 0.14 at 100 % | fast | 0.2 (0.125 to 0.275) | 0.2 | 5 % | 100.0 | 100.0 | 0 of 6 |" in text
    assert "| sync | - at 92.95 % | 0.13 at 100 % | 0.44 at 100 % | 0.15 at 100 % | not here | - |" in text
    assert "- lt3_00 fast seed 0 (exit code -1): RuntimeError: the worker was eaten" in text
    assert "- alt1_00: topic /tau_nodelet/thermal_image" in text
    assert "reference LOAM" in text


def test_every_run_has_a_line_with_its_figures(rovtio: Path, evaluate, tmp_path: Path) -> None:
    evaluate("--dataset", "rovtio", rovtio, "--runs", 2)
    with (tmp_path / "out" / "runs.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [(r["piece"], r["seed"]) for r in lines] == [(p, s) for p in ("alt1_00", "alt1_01", "lt1_00", "lt2_00", "lt3_00") for s in "01"]
    assert lines[1] | {"sequence": "alt1", "ate_rmse": "0.2", "ate_spread": "2", "ate_pairs": "20", "ate_path": "5", "error": ""} == lines[1]
    assert lines[4]["tracked_pct"] == "30" and lines[4]["ate_rmse"] == ""
    assert lines[6]["error"] == "thegra: no camera"
    content = json.loads((tmp_path / "out" / "results.json").read_text())
    assert len(content["results"]) == 10
    assert content["results"][0]["ate_rmse"] == 0.1


def test_what_is_done_is_not_run_again(rovtio: Path, evaluate, tmp_path: Path) -> None:
    out = tmp_path / "out"

    def calls() -> int:
        return sum(len(log.read_text().splitlines()) for log in out.rglob("calls.log"))

    evaluate("--dataset", "rovtio", rovtio)
    first = (out / "table.csv").read_text()
    assert calls() == 3
    again = evaluate("--dataset", "rovtio", rovtio, "--workers", 3)
    assert calls() == 3
    assert "run before" in again.stderr
    assert (out / "table.csv").read_text() == first
    evaluate("--dataset", "rovtio", rovtio, "--runs", 2)
    assert calls() == 6  # the second seeds
    evaluate("--dataset", "rovtio", rovtio, "--set", "weighting=uniform")
    assert calls() == 9  # another configuration
    bag = rovtio / "lt1" / "m100_0.bag"
    write_ros1(bag.with_suffix(".new"), thermal(TAU, 6, T0) + odometry(LOAM, walk(6)))
    bag.with_suffix(".new").replace(bag)
    evaluate("--dataset", "rovtio", rovtio, "--set", "weighting=uniform")
    assert calls() == 10  # a changed recording


def test_only_and_dry_run(rovtio: Path, evaluate, tmp_path: Path) -> None:
    done = evaluate("--dataset", "rovtio", rovtio, "--only", "alt1", "--dry-run")
    assert done.exit_code == 0
    assert "alt1_01: topic" in done.stderr and "lt2" not in done.stderr
    assert (tmp_path / "out" / "alt1_00" / "groundtruth.txt").is_file()
    assert not (tmp_path / "out" / "results.json").exists()
    evaluate("--dataset", "rovtio", rovtio, "--only", "alt1_01")
    content = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [r["piece"] for r in content["results"]] == ["alt1_01"]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--dataset", "kaist", "."], "known: vivid, rovtio"), (["--dataset", "vivid", "/no/such"], "/no/such does not exist"),
        (["--dataset", "vivid", "."], "no sequence of ViViD++"), (["--dataset", "rovtio", "DATA", "--only", "lt9"], "--only lt9: there is no such sequence"),
        (["--dataset", "rovtio", "DATA", "--profile", "best"], "known: paper"), (["--dataset", "rovtio", "DATA", "--set", "no.such=1"], "no"),
    ],
)  # fmt: skip
def test_wrong_use_is_told(rovtio: Path, evaluate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], told: str) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    monkeypatch.chdir(empty)
    done = evaluate(*[rovtio if a == "DATA" else a for a in arguments])
    assert done.exit_code == 2
    assert told in done.stderr


# ---- plans and figures ------------------------------------------------------------------------------------------------------------


def one(tmp_path: Path, **changed) -> Plan:
    bag = write_ros1(tmp_path / "a.bag", thermal(count=5) + odometry(LOAM, walk(5)))
    from thegra_core.evaluation.datasets.sequence import Reference

    sequence = DataSequence("a", bag, "/thermal/image_raw", reference=lambda: Reference(walk(5), "made"), row="a", start_s=1.5, duration_s=30.0)
    return replace(Plan("vivid", Found((sequence,)), tmp_path / "out"), **changed)


def test_the_command_of_a_run(tmp_path: Path) -> None:
    (job,) = plan_jobs(one(tmp_path, cache=tmp_path / "cache", max_frames=9, assignments=("weighting=uniform",)))
    words = job.task.command()
    assert words[3:7] == ["run", str(tmp_path / "a.bag"), "--out", str(tmp_path / "out" / "a" / "quality" / "seed0")]
    text = " ".join(words)
    for part in (
        "--profile quality --seed 0 --topic /thermal/image_raw", "--start 1.5 --duration 30.0", "--max-frames 9", "--set weighting=uniform",
        f"--groundtruth {tmp_path}/out/a/groundtruth.txt", f"--cache {tmp_path}/cache",
    ):  # fmt: skip
        assert part in text
    np.testing.assert_allclose(read_tum(job.task.groundtruth).poses, walk(5).poses, atol=1e-6)


def test_a_reference_that_cannot_be_read_is_told_and_costs_only_the_score(tmp_path: Path) -> None:
    from thegra_core.errors import InputError

    def broken():
        raise InputError("the table is torn")

    plan = one(tmp_path)
    sequence = replace(plan.found.sequences[0], reference=broken)
    (job,) = plan_jobs(replace(plan, found=Found((sequence,))))
    assert job.task.groundtruth is None
    assert job.reference == "no ground truth: the table is torn"


def test_a_reference_that_was_corrected_is_read_again(evaluate, tmp_path: Path) -> None:
    def reference() -> np.ndarray:
        evaluate("--dataset", "generic", tmp_path / "recordings.yaml", "--dry-run")
        return read_tum(tmp_path / "out" / "a" / "groundtruth.txt").positions

    write_ros1(tmp_path / "a.bag", thermal(count=5))
    for name, factor in (("one", 1.0), ("two", 10.0)):
        poses = walk(5).poses.copy()
        poses[:, :3, 3] *= factor
        (tmp_path / f"{name}.txt").write_text(format_tum(Trajectory(walk(5).stamps_ns, poses)))
    (tmp_path / "recordings.yaml").write_text("- {input: a.bag, groundtruth: one.txt}\n")
    first = reference()
    (tmp_path / "recordings.yaml").write_text("- {input: a.bag, groundtruth: two.txt}\n")
    np.testing.assert_allclose(reference(), 10 * first)  # another table
    (tmp_path / "two.txt").write_text((tmp_path / "one.txt").read_text() + "# corrected\n")
    np.testing.assert_allclose(reference(), first)  # the same table, corrected


def test_a_camera_that_was_edited_makes_another_task(tmp_path: Path) -> None:
    camera, bag = tmp_path / "c.yaml", write_ros1(tmp_path / "a.bag", thermal())
    camera.write_text("1,2,3,4\n")
    task = RunTask("a", bag, tmp_path / "out", ("--camera", f"{camera}:cam0"))
    before = task.identity()
    assert task.identity() == before
    camera.write_text("1,2,3,5\n")
    assert task.identity() != before


def test_errors_need_half_coverage(tmp_path: Path) -> None:
    (job,) = plan_jobs(one(tmp_path))
    good, bad = (Result(job, o, figures_of(job, o, Settings())) for o in (Outcome(0, metrics(tracked_pct=50.0)), Outcome(0, metrics(tracked_pct=49.99))))
    assert (good.figures["ate_rmse"], bad.figures["ate_rmse"], bad.figures["ate_rel"]) == (0.1, None, None)
    assert (failed(good), failed(bad)) == (False, True)
    assert bad.figures["ate_pairs"] == 20


def test_a_lever_arm_is_fitted_only_when_asked(tmp_path: Path) -> None:
    from test_honest_scores import CAMERA, as_estimate, path

    (job,) = plan_jobs(one(tmp_path))
    job.task.folder.mkdir(parents=True)
    (job.task.folder / "trajectory.txt").write_text(format_tum(as_estimate(path(CAMERA, arm=np.array([0.2, 0.1, 0.0])))))
    job.task.groundtruth.write_text(format_tum(path(CAMERA)))
    outcome = Outcome(0, metrics())
    assert "ate_fitted" not in figures_of(job, outcome, Settings())
    fitted = figures_of(job, outcome, Settings(fit_lever_arm=True))
    assert fitted["ate_fitted"] < 1e-4
    np.testing.assert_allclose(fitted["lever_arm"], [0.2, 0.1, 0.0], atol=1e-4)
    line = tables.lines_of([Result(job, outcome, fitted)])[0]
    assert "; fitted " in tables.table("vivid", [line], ["a"])[1][0][6]


def test_medians_count_a_failure_as_the_worst(tmp_path: Path) -> None:
    (job,) = plan_jobs(one(tmp_path))
    ates = [0.1, 0.2, None, 0.4]
    results = [Result(job, Outcome(0 if a else 2, {}, None if a else "x"), metrics(ate_rmse=a) if a else {}) for a in ates]
    (line,) = tables.lines_of(results)
    assert (line.runs, line.failures, line.ate_median, line.ate_mean) == (4, 1, 0.4, pytest.approx(0.7 / 3))
    assert line.ate_quartiles[1] is None
    (line,) = tables.lines_of([results[2], results[2], results[0]])
    assert line.ate_median is None


def test_the_papers_tables_are_whole() -> None:
    assert (len(ROVTIO), len(VIVID)) == (6, 14)
    assert all(len(row) == 4 for table in (ROVTIO, VIVID) for row in table.values())
    assert VIVID["dark_aggresive"][3] == ("<0.01", "100")
    assert VIVID["outdoor_robust_day2"][1] == ("2664.00", "100")


# ---- tasks and workers ------------------------------------------------------------------------------------------------------------


def test_a_real_run_that_fails_is_an_outcome(tmp_path: Path) -> None:
    outcome = execute(RunTask("x", tmp_path / "absent.bag", tmp_path / "out"))
    assert outcome.exit_code == 2
    assert "absent.bag does not exist" in outcome.error
    assert finished(tmp_path / "out", {}) is None


def test_a_real_run_is_done_once(tmp_path: Path) -> None:
    bag = write_ros1(tmp_path / "a.bag", thermal(count=3))
    camera = tmp_path / "camera.txt"
    camera.write_text("60 60 32 24 64 48\n")
    task = RunTask("a", bag, tmp_path / "out", ("--camera", str(camera), "--set", "extractor.name=orb", "--set", "preprocessing.filters=[{filter: he_clip}]"))
    first, second = execute(task), execute(task)
    assert (first.exit_code, first.error, first.resumed) == (1, None, False)  # three frames of noise
    assert (second.exit_code, second.resumed, second.metrics) == (1, True, first.metrics)
    (tmp_path / "out" / "metrics.json").write_text("{ half")
    assert not execute(task).resumed


def test_outcomes_are_in_order_whichever_ends_first(tmp_path: Path) -> None:
    import threading

    last_done = threading.Event()

    def runner(task: RunTask) -> Outcome:
        if task.name == "0":
            assert last_done.wait(30)
        elif task.name == "2":
            last_done.set()
        elif task.name == "1":
            raise OSError("disk full")
        return Outcome(0, {"name": task.name})

    told: list[int] = []
    tasks = [RunTask(str(i), tmp_path, tmp_path) for i in range(3)]
    outcomes = run_tasks(tasks, lambda place, outcome: told.append(place), workers=3, runner=runner)
    assert [o.metrics.get("name") for o in outcomes] == ["0", None, "2"]
    assert outcomes[1].error == "OSError: disk full"
    assert sorted(told) == [0, 1, 2]


def test_workers_share_the_cores(tmp_path: Path) -> None:
    seen: list[int] = []
    run_tasks([RunTask("a", tmp_path, tmp_path)], lambda *_: None, workers=64, runner=lambda task: seen.append(task.threads) or Outcome())
    run_tasks([RunTask("a", tmp_path, tmp_path)], lambda *_: None, runner=lambda task: seen.append(task.threads) or Outcome())
    assert seen == [1, 0]


@pytest.mark.filterwarnings("ignore")  # of a client that cannot connect
def test_a_scheduler_that_does_not_answer_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "CONNECT_S", 0.3)
    with pytest.raises(ConfigError, match="no scheduler answers"):
        run_tasks([RunTask("a", tmp_path, tmp_path)], lambda *_: None, dask="tcp://127.0.0.1:9", runner=pretend)




@pytest.mark.slow
@pytest.mark.parametrize(("dataset", "row", "told"), [("vivid", "dark_robust", "Vicon table indoor_robust_dark_gt.csv"), ("rovtio", "alt1", "reference LOAM")])
def test_a_simulated_recording_in_the_sets_layout_goes_all_the_way(tmp_path: Path, dataset: str, row: str, told: str) -> None:
    from thegra_core.simulation.simulate import SimulationOptions, simulate

    options = SimulationOptions(duration_s=2.4, rate_hz=5, image_size=(320, 256), seed=1, sensor={"netd_mk": 20})
    simulate(options, tmp_path / "data" / "alt1", dataset)
    arguments = ["evaluate", "--dataset", dataset, tmp_path / "data", "--out", tmp_path / "out", "--set", "extractor.name=orb", "--set", "preprocessing.filters=[{filter: he_clip}]"]
    done = CliRunner().invoke(app, list(map(str, arguments)))
    assert done.exit_code == 0, done.output
    content = json.loads((tmp_path / "out" / "results.json").read_text())
    (run,) = content["results"]
    assert run["sequence"] == row
    assert run["tracked_pct"] > 80 and run["ate_rmse"] < 0.2 and run["ate_pairs"] >= 9
    assert told in "; ".join(next(iter(content["notes"].values())))
