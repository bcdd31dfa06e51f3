from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from thegra_core.cli.main import app
from thegra_core.errors import ConfigError, InputError, ThegraError
from thegra_core.evaluation.benchmark.peers import best_peer, median_or_none, read_peers
from thegra_core.evaluation.benchmark.slam import Plan, PlannedRun, RunResult, figures_of, planned_runs, report, summarize
from thegra_core.evaluation.benchmark.tables import failures, markdown, table
from thegra_core.evaluation.scores import score_files
from thegra_core.outputs.trajectory import format_stamp, format_tum, make_trajectory
from thegra_core.simulation.sensor_config import SensorConfig
from thegra_core.simulation.simulate import SimulationOptions, simulate
from thegra_core.sources.open import open_recording

SECOND = 1_000_000_000
FRAMES = 12
EASY = SimulationOptions(duration_s=FRAMES / 5, rate_hz=5, image_size=(320, 256), seed=1, sensor=SensorConfig(netd_mk=20))
FAST_ENOUGH = ("--set", "extractor.name=orb", "--set", "preprocessing.filters=[{filter: he_clip}]")


def invoke(*arguments: str | Path):
    return CliRunner().invoke(app, [str(argument) for argument in arguments], env={"COLUMNS": "250", "TERM": "dumb"})


def path(count: int, step: float = 0.1, bend: float = 0.02) -> list[np.ndarray]:
    poses = [np.eye(4) for _ in range(count)]
    for i, pose in enumerate(poses):
        pose[:3, 3] = step * i, bend * i * i, 0
    return poses


def tum(poses: list[np.ndarray], rows: range | list[int] | None = None) -> str:
    """One pose a second from 100 s."""
    chosen = range(len(poses)) if rows is None else rows
    return format_tum(make_trajectory(((100 + i) * SECOND, poses[i]) for i in chosen))


def images(folder: Path, count: int) -> Path:
    folder.mkdir(exist_ok=True)
    lines = []
    for i in range(count):
        cv2.imwrite(str(folder / f"{i}.png"), np.zeros((8, 8), np.uint8))
        lines.append(f"{100 + i}.0 {i}.png\n")
    (folder / "images.txt").write_text("".join(lines))
    return folder


def run_folder(folder: Path, trajectory: str, **changed: object) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    metrics = {
        "frames_total": 10, "tracked_pct": 12.5, "maps": 1, "losses": 0, "relocalizations": 0, "keyframes": 3, "landmarks": 99, "finish_s": 0.1,
        "loops": 0, "shutter_closures": [], "cached_pct": None, "peak_mb": 300.0, "ms_per_frame": {"p50": 250.0, "p95": 1500.0, "p99": 2000.0},
    }  # fmt: skip
    (folder / "metrics.json").write_text(json.dumps(metrics | changed))
    (folder / "trajectory.txt").write_text(trajectory)
    (folder / "trajectory_live.txt").write_text(tum(path(50, step=9.0)))
    return folder


def planned(recording: Path, folder: Path, seed: int = 0, max_frames: int | None = None) -> PlannedRun:
    return PlannedRun(recording, "fast", seed, folder, max_frames)


def result(seed: int, **figures: object) -> RunResult:
    base = {
        "truth": "moving", "tracked_pct": 100.0, "ate_rmse": 0.1, "ate_rel": 0.01, "maps": 1, "losses": 0, "poses": 10, "extent": 2.0, "in_closure": 0,
        "spread": 10.0, "s_per_frame": {"p50": 0.25, "p95": 1.5}, "cached_pct": None, "peak_mb": 300.0, "ate_pct": 0.5, "ate_live_rmse": 0.2,
        "recall_1pct": 90.0, "fps": 4.0, "ms_stages": {"features": 120.4, "matching": 60.0, "preprocessing": 0.2, "total": 250.0},
    }  # fmt: skip
    return RunResult(PlannedRun(Path("/r/yard"), "fast", seed, Path("/out"), None), 0, base | figures)


def failed(seed: int) -> RunResult:
    return RunResult(PlannedRun(Path("/r/yard"), "fast", seed, Path("/out"), None), 2, {}, "thegra: no\n  camera")


# ---- the command ------------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of images with camera, ground truth, and a closure that no frame is in the middle of."""
    base = tmp_path_factory.mktemp("recordings")
    bag, folder = simulate(EASY, base / "bag"), base / "walk"
    folder.mkdir()
    lines = []
    for frame in open_recording(bag).frames():
        cv2.imwrite(str(folder / f"{frame.index}.png"), frame.image)
        lines.append(f"{format_stamp(frame.stamp_ns)} {frame.index}.png\n")
    (folder / "images.txt").write_text("".join(lines))
    for name in ("camera.yaml", "groundtruth.txt"):
        shutil.copy(bag / name, folder)
    return folder


@pytest.fixture(scope="module")
def ran(walk: Path, tmp_path_factory: pytest.TempPathFactory):
    out = tmp_path_factory.mktemp("out")
    peers = out / "peers.json"
    peers.write_text(json.dumps({"walk": {"other": {"best": {"tracked_pct": [90.0], "ate_rmse": [0.5]}}}}))
    broken = images(walk.parent / "no_camera", 3)
    done = invoke("benchmark", "slam", walk, broken, "--runs", 2, "--cache", out / "cache", "--peers", peers, "--out", out / "results", *FAST_ENOUGH)
    return done, out / "results", json.loads((out / "results" / "results.json").read_text())


def test_every_run_is_scored(ran, walk: Path) -> None:
    _, out, content = ran
    summary = content["results"][0]
    assert (summary["recording"], summary["profile"], summary["seeds"], summary["failed"]) == ("walk", "quality", [0, 1], [])
    for seed in (0, 1):
        folder = out / "walk" / "quality" / f"seed{seed}"
        score = score_files(folder / "trajectory.txt", walk / "groundtruth.txt", walk / "images.txt").absolute
        assert summary["tracked_pct"]["seeds"][seed] == score.tracked_pct >= 90
        assert summary["ate_rmse"]["seeds"][seed] == score.ate_rmse < 0.05
        assert (folder / "report.html").is_file()
    assert summary["peak_mb"] > 50
    assert summary["s_per_frame"]["p50"] > 0


def test_the_second_seed_has_the_networks_results_from_the_cache(ran) -> None:
    _, _, content = ran
    first, second = content["results"][0]["runs"]
    assert first["cached_pct"] < 50 < second["cached_pct"]


def test_a_failed_run_is_told_and_stops_nothing(ran) -> None:
    done, _, content = ran
    assert done.exit_code == 1
    assert [f["seed"] for f in content["results"][1]["failed"]] == [0, 1]
    assert "camera" in content["results"][1]["failed"][0]["error"]
    assert "failed: no_camera, quality, seed 0 (exit code 2)" in done.stderr
    assert "no_camera" in done.stdout


def test_the_tables_tell_the_same(ran) -> None:
    done, out, content = ran
    text = (out / "results.md").read_text()
    assert text == markdown(content)
    assert text.startswith("| recording | profile | tracked % | ATE RMSE |")
    assert "other best: 90 % at 0.5" in text and "other best: 90 % at 0.5" in done.stdout


def test_a_run_without_cache_writes_the_same_bytes_each_time(ran, walk: Path, tmp_path: Path) -> None:
    _, out, _ = ran
    assert invoke("run", walk, "--out", tmp_path, "--quiet", *FAST_ENOUGH).exit_code == 0
    for name in ("trajectory.txt", "trajectory_live.txt", "keyframes.txt", "map.ply"):
        assert (tmp_path / name).read_bytes() == (out / "walk" / "quality" / "seed0" / name).read_bytes()


def test_runs_at_a_time_change_neither_results_nor_their_order(ran, walk: Path, tmp_path: Path) -> None:
    _, out, content = ran
    done = invoke("benchmark", "slam", walk, "--runs", 3, "--workers", 3, "--cache", out.parent / "cache", "--out", tmp_path / "results", *FAST_ENOUGH)
    at_once = json.loads((tmp_path / "results" / "results.json").read_text())
    assert done.exit_code == 0
    assert at_once["results"][0]["seeds"] == [0, 1, 2]
    assert at_once["results"][0]["ate_rmse"]["seeds"][:2] == content["results"][0]["ate_rmse"]["seeds"]
    assert "3 runs at a time" in (tmp_path / "results" / "results.md").read_text()


# ---- plans ------------------------------------------------------------------------------------------------------------------------


def test_order_and_folders(tmp_path: Path) -> None:
    a, b = images(tmp_path / "a", 1), images(tmp_path / "b", 1)
    runs = planned_runs(Plan((a, b), tmp_path / "out", ("fast", "paper"), runs=2, max_frames={"b": 7}))
    assert [(r.name, r.profile, r.seed, r.max_frames) for r in runs] == [
        (name, profile, seed, limit) for name, limit in (("a", None), ("b", 7)) for profile in ("fast", "paper") for seed in (0, 1)
    ]
    assert len({r.folder for r in runs}) == 8


@pytest.mark.parametrize(
    ("change", "error", "told"),
    [
        ({"recordings": (Path("/no/such"),)}, InputError, "/no/such does not exist"),
        ({"recordings": (Path("/tmp"), Path("/var/../tmp"))}, InputError, "different names"),
        ({"max_frames": {"nowhere": 3}}, InputError, "no recording is called that"),
        ({"profiles": ("best",)}, ConfigError, "known: paper"),
        ({"assignments": ("seed",)}, ConfigError, "KEY=VALUE"),
        ({"assignments": ("tracking.no_such=1",)}, ConfigError, "tracking.no_such"),
    ],
)
def test_a_plan_that_cannot_work_is_refused_before_anything_runs(tmp_path: Path, change: dict, error: type[ThegraError], told: str) -> None:
    with pytest.raises(error, match=told):
        planned_runs(Plan(**({"recordings": (tmp_path,), "out": tmp_path} | change)))


@pytest.mark.parametrize("limit", ["7", "name=", "name=0", "=4", "name=x"])
def test_wrong_limits_are_refused(tmp_path: Path, limit: str) -> None:
    done = invoke("benchmark", "slam", tmp_path, "--max-frames", limit)
    assert done.exit_code == 2
    assert "write NAME=N" in done.stderr


# ---- figures ----------------------------------------------------------------------------------------------------------------------


def test_frames_in_closures_do_not_count_but_poses_there_are_told(tmp_path: Path) -> None:
    recording = images(tmp_path / "r", 10)
    (recording / "groundtruth.txt").write_text(tum(path(10)))
    (recording / "shutter.txt").write_text("103.5 105.5\n")
    figures = figures_of(planned(recording, run_folder(tmp_path / "out", tum(path(10), [0, 1, 2, 3, 4, 8]))))
    assert (figures["tracked_pct"], figures["in_closure"], figures["poses"], figures["truth"]) == (62.5, 1, 6, "moving")
    assert figures["ate_rmse"] == pytest.approx(0, abs=1e-6)
    assert figures["s_per_frame"] == {"p50": 0.25, "p95": 1.5}


def test_a_cut_recording_is_scored_over_its_part(tmp_path: Path) -> None:
    recording = images(tmp_path / "r", 10)
    (recording / "groundtruth.txt").write_text(tum(path(10)))
    figures = figures_of(planned(recording, run_folder(tmp_path / "out", tum(path(10), range(3))), max_frames=4))
    positions = np.array([p[:3, 3] for p in path(4)])
    assert figures["tracked_pct"] == 75
    assert figures["spread"] == pytest.approx(np.linalg.norm(positions.std(axis=0)), abs=1e-6)


@pytest.mark.parametrize("still", [False, True])
def test_without_motion_to_compare_with_the_claims_are_told(tmp_path: Path, still: bool) -> None:
    recording = images(tmp_path / "r", 10)
    if still:
        (recording / "groundtruth.txt").write_text(tum(path(10, step=0, bend=0)))
    out = run_folder(tmp_path / "out", tum(path(3, step=3, bend=2)))
    (out / "trajectory_map1.txt").write_text(tum(path(2)))
    result = RunResult(planned(recording, out), 0, figures_of(planned(recording, out)) | {"peak_mb": 300.0})
    assert (result.figures["poses"], result.figures["truth"]) == (5, "still" if still else "none")
    assert result.figures["extent"] == pytest.approx(10)
    row = table(report(Plan((recording,), tmp_path), [result]))[1][0]
    assert row[3] == f"{'does not move' if still else 'no ground truth'}: 5 poses, extent 10"
    assert row[4] == "–"


def test_a_bag_is_scored_as_the_run_scored_itself(tmp_path: Path) -> None:
    bag = simulate(SimulationOptions(duration_s=0.2, image_size=(32, 24)), tmp_path / "bag")
    figures = figures_of(planned(bag, run_folder(tmp_path / "out", "", ate_rmse=0.25, ate_rel=0.5)))
    assert (figures["tracked_pct"], figures["ate_rmse"], figures["ate_rel"], figures["truth"]) == (12.5, 0.25, 0.5, "moving")


def test_of_a_bag_with_closures_beside_frames_in_them_do_not_count(tmp_path: Path) -> None:
    bag = simulate(SimulationOptions(duration_s=2.0, rate_hz=5, image_size=(32, 24)), tmp_path / "bag")
    lines = (bag / "groundtruth.txt").read_text().splitlines()
    stamps = [frame.stamp_ns for frame in open_recording(bag).frames()]
    assert len(stamps) == 10
    (bag / "shutter.txt").write_text(f"{format_stamp(stamps[3] - 1)} {format_stamp(stamps[5] + 1)}\n")
    truth = "".join(line + "\n" for line in lines if not line.startswith("#"))
    given = "".join(line + "\n" for i, line in enumerate(truth.splitlines()) if i not in (3, 4, 5, 9))
    figures = figures_of(planned(bag, run_folder(tmp_path / "out", given)))
    assert (figures["tracked_pct"], figures["in_closure"], figures["ate_rmse"]) == (pytest.approx(100 * 6 / 7, abs=0.01), 0, pytest.approx(0, abs=1e-6))


# ---- summaries --------------------------------------------------------------------------------------------------------------------


def test_medians_count_what_is_missing_as_the_worst() -> None:
    assert median_or_none([3.0, 1.0, 2.0]) == 2
    assert median_or_none([None, 1.0, 2.0]) == 2
    assert median_or_none([None, None, 2.0]) is None
    assert median_or_none([None, None, 2.0], worst=0.0) == 0
    assert median_or_none([]) is None


def test_a_summary_has_every_seed() -> None:
    runs = [result(0, ate_rmse=0.3, peak_mb=400.0), failed(1), result(2, ate_rmse=0.1, s_per_frame={"p50": 9, "p95": 9}), result(3, ate_rmse=None)]
    summary = summarize(runs)
    assert summary["ate_rmse"] == {"median": 0.3, "seeds": [0.3, None, 0.1, None]}
    assert summary["s_per_frame"] == {"p50": 0.25, "p95": 1.5}
    assert summary["peak_mb"] == 400
    assert [f["seed"] for f in summary["failed"]] == [1]
    content = report(Plan((Path("/r/yard"),), Path("/out"), runs=4), runs)
    assert failures(content) == ["yard, fast, seed 1 (exit code 2): thegra: no camera"]
    assert table(content)[1][0][2:5] == ["100.0 (100.0, –, 100.0, 100.0)", "0.3 (0.3, –, 0.1, –)", "1 %"]


def test_a_row_tells_speed_live_error_and_recall() -> None:
    header, rows = table(report(Plan((Path("/r/yard"),), Path("/out")), [result(0)]))
    row = dict(zip(header, rows[0], strict=True))
    assert (row["of path"], row["live ATE"], row["recall %"], row["fps"], row["ms a stage"]) == ("0.5 %", "0.2", "90.0", "4", "features 120, matching 60")


def test_no_error_is_told_of_a_run_that_tracks_less_than_half() -> None:
    summary = summarize([result(0, tracked_pct=49.0), result(1, tracked_pct=50.0, ate_rmse=0.2)])
    assert summary["ate_rmse"] == {"median": None, "seeds": [None, 0.2]}
    assert summary["recall_1pct"]["seeds"] == [90.0, 90.0]
    assert summary["runs"][0]["ate_rmse"] == 0.1


def test_a_recording_whose_runs_all_failed_has_a_row() -> None:
    content = report(Plan((Path("/r/yard"),), Path("/out")), [failed(0)], {})
    assert table(content)[1][0][:3] == ["yard", "fast", "failed"]
    json.dumps(content, allow_nan=False)


def test_profiles_are_compared_with_the_first() -> None:
    def run(name: str, profile: str, **figures: object) -> RunResult:
        made = result(0, **figures)
        return RunResult(PlannedRun(Path("/r") / name, profile, 0, Path("/out"), None), 0, made.figures)

    runs = [run("yard", "quality"), run("yard", "fast", ate_rmse=0.2), run("hall", "quality", ate_rmse=0.2), run("hall", "fast", ate_rmse=0.1, tracked_pct=80.0)]
    runs += [run("still", profile, truth="still", ate_rmse=None) for profile in ("quality", "fast")]
    content = report(Plan((Path("/r/yard"), Path("/r/hall")), Path("/out"), ("quality", "fast")), runs)
    (found,) = content["comparisons"]
    assert (found["label"], found["against"], found["recordings"], found["ratio"], found["tracked_pct"]) == ("fast", "quality", 2, pytest.approx(1), (90.0, 100.0))
    assert "ATE of fast over that of quality: 1.00 (95 %: 0.00 to " in markdown(content)
    json.dumps(content, allow_nan=False)


# ---- peers ------------------------------------------------------------------------------------------------------------------------


def test_the_best_peer_tracks_half_with_the_least_error() -> None:
    systems = {
        "precise": {"a": {"tracked_pct": [49.0, 49.0, 90.0], "ate_rmse": [0.01, 0.01, 0.01]}},
        "steady": {"a": {"tracked_pct": [60.0], "ate_rmse": [0.3]}, "b": {"tracked_pct": [55.0, 50.0, 45.0], "ate_rmse": [0.2, 0.1, 0.9]}},
        "lost": {"a": {"tracked_pct": [90.0], "ate_rmse": [None]}},
    }
    assert best_peer(systems) == {"peer": "steady", "variant": "b", "tracked_pct": 50.0, "ate_rmse": 0.2}
    assert best_peer({"lost": systems["lost"]}) is None


def test_peers_in_the_table() -> None:
    others = {"yard": {"peer": {"v": {"tracked_pct": [80.0], "ate_rmse": [2.0]}}}}
    plan = Plan((Path("/r/yard"),), Path("/out"))
    assert table(report(plan, [result(0)], others))[1][0][-1] == "peer v: 80 % at 2 (20 % of spread)"
    assert table(report(plan, [result(0)], {}))[1][0][-1] == "none tracks 50 %"


@pytest.mark.parametrize("content", ["", "[]", '{"a": {"b": {"c": {}}}}', '{"a": {"b": 3}}'])
def test_a_file_of_another_form_is_refused(tmp_path: Path, content: str) -> None:
    file = tmp_path / "peers.json"
    file.write_text(content)
    with pytest.raises(InputError, match="expected JSON"):
        read_peers(file)
