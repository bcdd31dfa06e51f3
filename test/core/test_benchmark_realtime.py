"""The benchmark of live runs, without running any."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from thegra_core.cli.main import app
from thegra_core.evaluation.benchmark import realtime
from thegra_core.evaluation.benchmark.slam import Plan, PlannedRun, RunResult, command, figures_of, planned_runs
from thegra_core.evaluation.suite import SUITE

MS = {"p50": 20.0, "p95": 40.0, "p99": 60.0}
FIGURES = {
    "frames_total": 200, "dropped_frames": 3, "latency_ms": MS, "cpu_s_per_frame": 0.0421, "tracked_pct": 97.5, "ate_rmse": 0.0123, "ate_live_rmse": 0.0234,
    "peak_mb": 812.3, "ms": {"preprocessing": {"p50": 5.0, "p95": 6.0, "p99": 7.0}, "mapping": {"p50": 0.0, "p95": 0.2, "p99": 3.0}, "total": MS},
}  # fmt: skip


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str, bool]]:
    """Answers runs with figures; recording, profile and haste of each in order. ORB fails offline."""
    done: list[tuple[str, str, bool]] = []

    def execute(run: PlannedRun, plan: Plan) -> RunResult:
        done.append((run.name, run.profile, plan.realtime))
        if run.profile == "fast" and not plan.realtime:
            return RunResult(run, 2, {}, "no\nweights")
        return RunResult(run, 0, FIGURES if plan.realtime else FIGURES | {"latency_ms": None, "ate_rmse": 0.011})

    monkeypatch.setattr(realtime, "execute", execute)
    return done


def test_each_is_run_live_and_offline(ran: list[tuple[str, str, bool]], tmp_path: Path) -> None:
    (tmp_path / "hall").mkdir()
    content = realtime.benchmark([tmp_path / "hall"], ("realtime", "fast"), tmp_path / "out", True, (), lambda _: None)
    assert ran == [("hall", "realtime", True), ("hall", "realtime", False), ("hall", "fast", True), ("hall", "fast", False)]
    assert json.loads((tmp_path / "out" / "results.json").read_text()) == content
    assert realtime.failures(content) == ["hall, fast, offline (exit code 2): no weights"]
    first, second = (line.split(" | ") for line in (tmp_path / "out" / "results.md").read_text().splitlines()[2:4])
    assert first == [
        "| hall", "realtime", "1.5", "20 / 40 / 60", "0.042", "20 / 40 / 60", "preprocessing 5 / 6 / 7", "97.5", "97.5", "0.0123", "0.0234", "0.011", "812 |",
    ]  # fmt: skip
    assert second[8] == second[11] == "–"


def test_offline_runs_can_be_left_out(ran: list[tuple[str, str, bool]], tmp_path: Path) -> None:
    (tmp_path / "hall").mkdir()
    content = realtime.benchmark([tmp_path / "hall"], ("realtime",), tmp_path / "out", False, (), lambda _: None)
    assert ran == [("hall", "realtime", True)]
    assert content["results"][0]["offline"] is None and realtime.failures(content) == []


def test_beside_another_profile(ran: list[tuple[str, str, bool]], tmp_path: Path) -> None:
    for name in ("hall", "yard"):
        (tmp_path / name).mkdir()
    content = realtime.benchmark([tmp_path / "hall", tmp_path / "yard"], ("realtime",), tmp_path / "out", True, ("seed=1",), lambda _: None, "quality")
    assert ran[-2:] == [("hall", "quality", False), ("yard", "quality", False)]
    text = (tmp_path / "out" / "results.md").read_text()
    assert [line.split(" | ")[-1] for line in text.splitlines()[:4]] == ["ATE of quality |", "--- |", "0.011 |", "0.011 |"]
    assert "ATE of realtime live over that of quality offline: 1.12 (95 %: 1.12 to 1.12), geometric mean of 2 recordings; tracked 97.5 and 97.5 %." in text
    assert "ATE of realtime offline over that of quality offline: 1.00" in text
    assert json.loads((tmp_path / "out" / "results.json").read_text())["comparisons"][0]["ratio"] == pytest.approx(0.0123 / 0.011)
    assert realtime.failures(content) == []


def test_what_another_profile_fails_in_is_told(ran: list[tuple[str, str, bool]], tmp_path: Path) -> None:
    (tmp_path / "hall").mkdir()
    content = realtime.benchmark([tmp_path / "hall"], ("realtime",), tmp_path / "out", False, (), lambda _: None, "fast")
    assert content["comparisons"] == []
    assert realtime.failures(content) == ["hall, fast, offline (exit code 2): no weights"]


def test_a_live_run_is_the_command_with_its_option(tmp_path: Path) -> None:
    plan = Plan((tmp_path,), tmp_path / "out", ("realtime",), realtime=True)
    (run,) = planned_runs(plan)
    assert "--realtime" in command(run, plan)
    assert "--realtime" not in command(run, Plan((tmp_path,), tmp_path / "out"))


def test_figures_of_a_live_run(tmp_path: Path) -> None:
    metrics = {
        "frames_total": 10, "tracked_pct": 80.0, "maps": 1, "losses": 0, "relocalizations": 0, "keyframes": 3, "landmarks": 99, "finish_s": 0.1, "loops": 0,
        "shutter_closures": [], "cached_pct": None, "peak_mb": 300.0, "ms_per_frame": MS, "fps": 9.0, "ms": {"total": MS}, "latency_ms": MS,
        "dropped_frames": 2, "cpu_s_per_frame": 0.05,
    }  # fmt: skip
    recording = tmp_path / "recording"
    recording.mkdir()
    (recording / "0.png").write_bytes(b"")
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "metrics.json").write_text(json.dumps(metrics))
    figures = figures_of(PlannedRun(recording, "realtime", 0, folder, None))
    assert (figures["dropped_frames"], figures["cpu_s_per_frame"], figures["latency_ms"], figures["ms"]) == (2, 0.05, MS, {"total": MS})


def test_the_simulated_walk_in_each_size_and_rate(tmp_path: Path) -> None:
    told: list[tuple[str, int, int]] = []
    made = realtime.simulated(tmp_path, [(64, 48), (96, 64)], [2.0, 4.0], 1.0, lambda *news: told.append(news))
    assert [path.name for path in made] == ["room_64x48_2hz_1s", "room_64x48_4hz_1s", "room_96x64_2hz_1s", "room_96x64_4hz_1s"]
    assert [len((path / "images.txt").read_text().splitlines()) for path in made] == [2, 4, 2, 4]
    assert len(told) == 16
    assert realtime.simulated(tmp_path, [(64, 48)], [2.0], 1.0, lambda *news: told.append(news)) == made[:1] and len(told) == 16, "what is there is kept"


def test_the_suite_as_another_camera_would_see_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    short = {name: options.model_copy(update={"duration_s": 1.0}) for name, options in SUITE.items() if name in ("street_robust", "tunnel_unstable")}
    monkeypatch.setattr(realtime, "SUITE", short)
    made = realtime.simulated_suite(tmp_path, [(64, 48)], [3.0], lambda *_: None)
    assert [path.name for path in made] == ["street_robust_64x48_3hz", "tunnel_unstable_64x48_3hz"]
    assert [len((path / "images.txt").read_text().splitlines()) for path in made] == [3, 3]


def test_wrong_sizes_are_told() -> None:
    result = CliRunner().invoke(app, ["benchmark", "realtime", "--size", "big"])
    assert result.exit_code == 2 and "write WIDTHxHEIGHT" in result.output
