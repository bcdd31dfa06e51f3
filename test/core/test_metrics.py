from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from made_runs import BEGIN_NS, PERIOD_NS, make_camera, make_run, true_pose

from thegra_core.config import load_config
from thegra_core.errors import InputError
from thegra_core.messages import Revisit
from thegra_core.outputs.files import sha256_of, write_atomic
from thegra_core.outputs.metrics import Timing, run_metrics, score_run
from thegra_core.outputs.pointcloud import format_ply
from thegra_core.outputs.trajectory import format_tum, make_trajectory, read_tum
from thegra_core.outputs.write import RecordingFacts, write_run

REQUIRED = ["frames_total", "frames_tracked", "frames_held", "frames_lost", "frames_initializing", "frames_bad", "tracked_pct", "tracked_any_pct", "maps", "keyframes", "landmarks", "losses", "relocalizations", "loops", "merges", "loop_events", "loss_events", "shutter_closures", "fps", "ms_per_frame", "ms", "dropped_frames", "peak_rss_mb", "seed", "profile", "version"]
WITH_TRUTH = ["ate_rmse", "ate_live_rmse", "ate_scale", "path_length"]
TIMING = Timing(wall_s=4.0, frames_read=20, finish_s=0.5)


@pytest.fixture
def groundtruth(tmp_path: Path) -> Path:
    file = tmp_path / "truth.txt"
    file.write_text(format_tum(make_trajectory((BEGIN_NS + i * PERIOD_NS, true_pose(i)) for i in range(40))))
    return file


def facts(tmp_path: Path, **changes) -> RecordingFacts:
    recording = tmp_path / "recording.bag"
    recording.write_bytes(b"thermal")
    return replace(RecordingFacts("recording", recording, "/thermal", make_camera(), weights={"net.pth": "ab" * 32}), **changes)


def test_counts_of_a_run() -> None:
    metrics = run_metrics(make_run("iiittttthhtttllrttttt", localized=(1, 2), other_map_from=19), load_config(), Timing(2.1, 21))
    assert metrics["frames_total"] == 21
    assert metrics["frames_tracked"] == 13  # 11 live in map 0, 2 localised afterwards
    assert metrics["frames_tracked_other_maps"] == 2
    assert metrics["frames_localized_afterwards"] == 2
    assert (metrics["frames_held"], metrics["frames_lost"], metrics["frames_initializing"]) == (2, 3, 1)
    assert metrics["tracked_pct"] == pytest.approx(100 * 13 / 21, abs=0.01)
    assert metrics["tracked_any_pct"] == pytest.approx(100 * 15 / 21, abs=0.01)
    assert metrics["shutter_closures"] == [[1_700_000_000.7, 1_700_000_000.9]]
    assert metrics["fps"] == 10.0
    parts = ("frames_tracked", "frames_tracked_other_maps", "frames_held", "frames_lost", "frames_initializing")
    assert sum(metrics[part] for part in parts) == metrics["frames_total"]


def test_keys_are_all_there(groundtruth: Path) -> None:
    run = make_run()
    assert set(REQUIRED) <= run_metrics(run, load_config(), TIMING).keys()
    assert not set(WITH_TRUTH) & run_metrics(run, load_config(), TIMING).keys()
    assert set(REQUIRED + WITH_TRUTH) <= run_metrics(run, load_config(), TIMING, score_run(run, read_tum(groundtruth))).keys()


def test_times_are_those_of_the_stages() -> None:
    metrics = run_metrics(make_run("ttttt"), load_config(), Timing(1.0, 5))
    assert metrics["ms"]["features"]["p50"] == 102.0
    assert metrics["ms_per_frame"]["p50"] == 162.0
    assert metrics["ms_per_frame"]["p99"] == pytest.approx(163.96)
    assert metrics["peak_rss_mb"] > 10


def test_bad_and_unreadable_frames_are_counted() -> None:
    run = replace(make_run("ttttt"), bad_frames={"all black": 2})
    metrics = run_metrics(run, load_config(), Timing(1.0, 5), unreadable={"damaged png": 3})
    assert (metrics["frames_total"], metrics["frames_bad"]) == (8, 5)
    assert metrics["bad_frames"] == {"all black": 2, "damaged png": 3}
    assert metrics["tracked_pct"] == 62.5


def test_errors_are_of_the_main_map_over_the_frames_of_the_run(groundtruth: Path) -> None:
    run = make_run(noise=0.02)
    scores = score_run(run, read_tum(groundtruth))
    assert scores.final.ate_rmse == pytest.approx(0.04 * np.sqrt(3), rel=0.3)  # noise over the scale of 0.5
    assert scores.live.ate_rmse > 1.5 * scores.final.ate_rmse
    assert scores.final.scale == pytest.approx(2, rel=0.05)
    steps = [np.linalg.norm(true_pose(i + 1)[:3, 3] - true_pose(i)[:3, 3]) for i in range(len(run.frames) - 1)]
    assert scores.final.path_length == pytest.approx(sum(steps))  # the truth goes on for 20 frames more


def test_every_file_is_written(tmp_path: Path, groundtruth: Path) -> None:
    run, out = make_run(other_map_from=17, noise=0.01), tmp_path / "out"
    written = write_run(run, out, load_config("fast"), facts(tmp_path), groundtruth, TIMING)
    names = {"trajectory.txt", "trajectory_live.txt", "trajectory_map1.txt", "predicted.txt", "keyframes.txt", "map.ply", "metrics.json", "config.yaml", "report.html", "overview.png"}
    assert {p.name for p in out.iterdir()} == names
    assert {p.name for p in written.files} == names
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics == written.metrics
    assert len(read_tum(out / "trajectory.txt")) == metrics["frames_tracked"]
    assert len(read_tum(out / "trajectory_map1.txt")) == metrics["frames_tracked_other_maps"]


def test_predictions_are_in_the_file_of_the_map_they_belong_to(tmp_path: Path) -> None:
    write_run(make_run("tthttttthh", other_map_from=8), tmp_path / "out", load_config(), facts(tmp_path), None, TIMING)
    assert len(read_tum(tmp_path / "out" / "predicted.txt")) == 1
    assert len(read_tum(tmp_path / "out" / "predicted_map1.txt")) == 2


def test_a_second_run_leaves_nothing_of_the_first(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_run(make_run(other_map_from=17), out, load_config(), facts(tmp_path), None, TIMING)
    write_run(make_run("ttttt"), out, load_config(), facts(tmp_path), None, TIMING)
    assert not (out / "trajectory_map1.txt").exists()
    assert not (out / "predicted.txt").exists()


@pytest.mark.parametrize("states", ["", "iiiii", "lllll"])
def test_a_run_without_a_map_has_all_files_too(tmp_path: Path, groundtruth: Path, states: str) -> None:
    written = write_run(make_run(states, localized=()), tmp_path / "out", load_config(), facts(tmp_path), groundtruth, Timing(0.0, len(states)))
    assert written.metrics["frames_tracked"] == 0
    assert written.metrics["ate_rmse"] is None
    assert (tmp_path / "out" / "trajectory.txt").read_text() == ""
    assert "element vertex 0" in (tmp_path / "out" / "map.ply").read_bytes().decode("ascii")


def test_the_configuration_repeats_the_run(tmp_path: Path) -> None:
    config = load_config("fast", overrides={"seed": 7, "tracking.min_inliers": 31})
    out, recording = tmp_path / "out", facts(tmp_path)
    write_run(make_run(), out, config, recording, None, TIMING)
    assert load_config(file=out / "config.yaml") == config
    told = yaml.safe_load((out / "config.yaml").read_text())["run"]
    assert told["input"]["sha256"] == sha256_of(recording.path)
    assert told["weights_sha256"] == {"net.pth": "ab" * 32}
    assert told["seed"] == 7
    assert told["packages"]["numpy"] == np.__version__


def test_ground_truth_that_is_none_stops_nothing_else(tmp_path: Path) -> None:
    bad = tmp_path / "bad.txt"
    bad.write_text("1 2 3\n")
    with pytest.raises(InputError, match=r"bad.txt:1"):
        write_run(make_run(), tmp_path / "out", load_config(), facts(tmp_path), bad, TIMING)
    assert "ate_rmse" not in json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert (tmp_path / "out" / "report.html").is_file()


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="--out DIR"):
        write_run(make_run(), tmp_path / "file" / "out", load_config(), facts(tmp_path), None, TIMING)


def test_point_cloud_holds_the_points() -> None:
    points = np.array([[1, 2, 3], [4, 5, 6.5]])
    data = format_ply(points, np.array([0.1, 0.9], np.float32))
    header, body = data.split(b"end_header\n", 1)
    assert b"format binary_little_endian 1.0" in header
    assert b"element vertex 2" in header
    vertices = np.frombuffer(body, np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)]))
    np.testing.assert_array_equal(vertices["xyz"], points)
    assert vertices["rgb"][0].sum() < vertices["rgb"][1].sum()  # a better score is brighter


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = write_atomic(tmp_path / "a.txt", "old")
    monkeypatch.setattr("os.fsync", lambda fd: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        write_atomic(file, "new")
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_the_checksum_leaves_out_results_that_lie_in_the_input(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    (folder / "1.png").write_bytes(b"one")
    before = sha256_of(folder)
    write_run(make_run(), folder / "out", load_config(), facts(tmp_path, path=folder), None, TIMING)
    assert yaml.safe_load((folder / "out" / "config.yaml").read_text())["run"]["input"]["sha256"] == before


def test_checksum_of_a_folder_sees_names_and_contents(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "1.png").write_bytes(b"one")
    first = sha256_of(tmp_path)
    (tmp_path / "a" / "1.png").rename(tmp_path / "a" / "2.png")
    second = sha256_of(tmp_path)
    (tmp_path / "a" / "2.png").write_bytes(b"two")
    assert len({first, second, sha256_of(tmp_path)}) == 3


def test_losses_and_revisits_are_told_one_by_one() -> None:
    run = replace(
        make_run("iitthtlllhltttllrt"),
        revisits=(Revisit(BEGIN_NS + 3 * PERIOD_NS, 0, 9, 2, 80, 0.25, 1.1), Revisit(BEGIN_NS + 9 * PERIOD_NS, 0, 20, 4, 60, 0.0, 2.0, 1)),
    )
    metrics = run_metrics(run, load_config("quality"), TIMING)
    begin = BEGIN_NS / 1e9
    assert [(round(e["lost_s"] - begin, 2), round(e["found_s"] - begin, 2)) for e in metrics["loss_events"]] == [(0.6, 1.1), (1.4, 1.7)]
    loop, merge = metrics["loop_events"]
    assert (loop["kind"], merge["kind"], merge["absorbed_map_id"]) == ("loop", "merge", 1)
    assert loop["stamp_s"] == pytest.approx(begin + 0.3) and (loop["moved"], loop["scale"], loop["landmarks"]) == (0.25, 1.1, 80)
    assert json.loads(json.dumps(metrics["loop_events"])) == metrics["loop_events"]
