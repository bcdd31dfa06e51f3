from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from made_runs import BEGIN_NS, PERIOD_NS, FakeRecording, FakeSystem, make_camera, make_run, true_pose
from typer.testing import CliRunner

from thegra_core.cli import run as run_module
from thegra_core.cli.config import filter_parameters, parameters
from thegra_core.cli.main import app
from thegra_core.cli.progress import News, without_figures
from thegra_core.config import ThegraConfig, load_config
from thegra_core.errors import InputError
from thegra_core.messages import Run, TrackingResult, TrackingState
from thegra_core.outputs.trajectory import format_tum, make_trajectory, read_tum

COMMANDS = ["run", "info", "score", "evaluate", "ablation", "config", "doctor", "benchmark slam", "benchmark realtime", "weights list", "weights fetch", "weights verify"]


def invoke(*arguments: str | Path):
    return CliRunner().invoke(app, [str(argument) for argument in arguments], env={"COLUMNS": "200", "TERM": "dumb"})


@pytest.fixture
def play(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Lets `thegra run` play a made run; returns the folder of results and the call."""

    def go(run: Run, *options: str, recording: FakeRecording | None = None, system: FakeSystem | None = None) -> tuple:
        source = recording or FakeRecording(tmp_path, count=len(run.frames))
        monkeypatch.setattr(run_module, "open_recording", lambda path, topic, shutter_topic: source)
        monkeypatch.setattr(run_module, "make_system", lambda camera, config: system or FakeSystem(run))
        monkeypatch.setattr(run_module, "make_live_system", lambda camera, config: system or FakeSystem(run))
        out = tmp_path / "out"
        return invoke("run", tmp_path, "--out", out, *options), out

    return go


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    file = tmp_path / "truth.txt"
    file.write_text(format_tum(make_trajectory((BEGIN_NS + i * PERIOD_NS, true_pose(i)) for i in range(20))))
    return file


# ---- help, version, wrong use -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_shows_an_example(command: str) -> None:
    result = invoke(*command.split(), "--help")
    assert result.exit_code == 0
    assert re.search(rf"Example: +thegra {command}", result.output)


def test_help_lists_every_command() -> None:
    result = invoke("--help")
    assert result.exit_code == 0
    for command in {c.split()[0] for c in COMMANDS}:
        assert f" {command} " in result.output


def test_version() -> None:
    result = invoke("--version")
    assert result.exit_code == 0
    assert re.fullmatch(r"thegra \S+\n", result.output)


def test_help_imports_no_heavy_library() -> None:
    code = "import sys, thegra_core.cli.main; print([m for m in ('torch', 'kornia', 'gtsam', 'matplotlib', 'skimage', 'cv2', 'rosbags', 'rerun') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["run"], "Missing argument 'INPUT'"),
        (["run", "x", "--max-frames", "0"], "--max-frames"),
        (["run", "x", "--no-such-option"], "No such option"),
        (["fly"], "No such command"),
        (["run", "/no/such/file.bag"], "/no/such/file.bag does not exist"),
        (["info", "/no/such/file.bag"], "/no/such/file.bag does not exist"),
        (["run", "x", "--profile", "best"], "known: paper, quality, fast"),
        (["run", "x", "--set", "seed"], "write KEY=VALUE"),
        (["run", "x", "--set", "tracking.min_inliers=2"], "tracking.min_inliers"),
        (["run", "x", "--set", "tracking.no_such=2"], "tracking.no_such"),
        (["run", "x", "--config", "/no/such.yaml"], "cannot read /no/such.yaml"),
        (["score", "/no/a.txt", "/no/b.txt"], "cannot read the trajectory /no/a.txt"),
        (["config", "--profile", "best"], "known: paper, quality, fast"),
    ],
)
def test_wrong_use_is_one_message_and_code_2(arguments: list[str], told: str) -> None:
    result = invoke(*arguments)
    assert result.exit_code == 2
    assert told in result.stderr
    assert "Traceback" not in result.output
    assert result.stdout == ""


def test_missing_intrinsics_show_a_file_to_fill_in(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for i in range(3):
        cv2.imwrite(str(folder / f"{i}.png"), np.full((48, 64), 40 * i, np.uint8))
    result = invoke("run", folder, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert "camera_matrix" in result.stderr
    assert "image_width: 64" in result.stderr
    assert "--camera camera.yaml" in result.stderr
    assert not (tmp_path / "out").exists()


def test_camera_of_another_size_is_refused(play) -> None:
    recording = FakeRecording(Path("x"), camera=make_camera((640, 512)))
    result, _ = play(make_run(), recording=recording)
    assert result.exit_code == 2
    assert "64x48" in result.stderr
    assert "640x512" in result.stderr


@pytest.mark.parametrize(("option", "value", "told"), [("--groundtruth", "/no/truth.txt", "cannot read the trajectory /no/truth.txt"), ("--viewer", "paraview", "known: none, rerun")])
def test_wrong_options_of_run_stop_before_the_work(play, option: str, value: str, told: str) -> None:
    result, out = play(make_run(), option, value)
    assert result.exit_code == 2
    assert told in result.stderr
    assert not out.exists()


# ---- run --------------------------------------------------------------------------------------------------------------------------


def test_a_run_writes_everything_and_tells_where(play, truth: Path) -> None:
    result, out = play(make_run(noise=0.01), "--groundtruth", truth)
    assert result.exit_code == 0, result.output
    for name in ("trajectory.txt", "trajectory_live.txt", "keyframes.txt", "map.ply", "metrics.json", "config.yaml", "report.html", "thegra.log"):
        assert (out / name).is_file(), name
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames_total"] == 20
    assert f"{metrics['tracked_pct']:g} %" in result.stdout
    assert f"{metrics['ate_rmse']:.4g} over" in result.stdout
    assert str(out / "report.html") in result.stdout
    assert "tracking" in (out / "thegra.log").read_text()


def test_the_reason_for_waiting_is_told_once(play) -> None:
    result, _ = play(make_run("iiiiittttt"))
    assert result.stderr.count("the camera has not moved enough") == 1


def test_reasons_that_differ_in_figures_only_are_the_same() -> None:
    assert without_figures("parallax 0.47 deg, 1 needed") == without_figures("parallax 12 deg, 1 needed")
    assert without_figures("parallax 0.47 deg") != without_figures("no parallax: 80 %")


def test_reasons_are_told_once_a_state() -> None:
    def result(state: TrackingState, reason: str = "") -> TrackingResult:
        return TrackingResult(0, state, reason=reason)

    news, lost, tracking = News(), TrackingState.LOST, TrackingState.TRACKING
    told = [result(lost, "16 of 25"), result(lost, "no matches"), result(lost, "14 of 25"), result(tracking), result(tracking), result(lost, "9 of 25")]
    assert [news.is_new(r) for r in told] == [True, True, False, True, False, True]


def test_quiet_prints_one_line(play, truth: Path) -> None:
    result, out = play(make_run(), "--quiet", "--groundtruth", truth)
    assert result.exit_code == 0
    assert result.stderr == ""
    assert re.fullmatch(rf"16 of 20 frames tracked \(80 %\), ATE \S+; {out}\n", result.stdout)
    assert (out / "thegra.log").read_text()


def test_ground_truth_beside_the_input_is_used(play, truth: Path, tmp_path: Path) -> None:
    _, out = play(make_run(), recording=FakeRecording(tmp_path, groundtruth=truth))
    assert "ate_rmse" in json.loads((out / "metrics.json").read_text())


def test_ground_truth_beside_the_input_that_is_none_is_left_out(play, tmp_path: Path) -> None:
    file = tmp_path / "groundtruth.txt"
    file.write_text("x,y\n")
    result, out = play(make_run(), recording=FakeRecording(tmp_path, groundtruth=file))
    assert result.exit_code == 0
    assert "ate_rmse" not in json.loads((out / "metrics.json").read_text())
    assert "groundtruth.txt:1" in (out / "thegra.log").read_text()


@pytest.mark.parametrize("states", ["iiiii", "iiill"])
def test_nothing_tracked_is_code_1(play, states: str) -> None:
    result, out = play(make_run(states, localized=()), "--quiet")
    assert result.exit_code == 1
    assert "0 of 5 frames tracked (0 %): the camera has not moved enough" in result.stdout
    assert (out / "report.html").is_file()


@pytest.mark.parametrize(
    ("options", "indices"),
    [
        (["--max-frames", "4"], [0, 1, 2, 3]),
        (["--start", "0.5", "--max-frames", "3"], [5, 6, 7]),
        (["--start", "1.2", "--duration", "0.3"], [12, 13, 14]),
        (["--duration", "0.25"], [0, 1, 2]),
    ],
)
def test_the_wanted_part_is_processed(play, options: list[str], indices: list[int]) -> None:
    run = make_run("t" * 20)
    system = FakeSystem(run)
    seen: list[int] = []
    track = system.track
    system.track = lambda prepared: seen.append(prepared.frame.index) or track(prepared)  # type: ignore[method-assign]
    result, out = play(run, *options, system=system)
    assert result.exit_code == 0
    assert seen == indices
    assert json.loads((out / "metrics.json").read_text())["frames_total"] == len(indices)


@pytest.mark.parametrize(("back", "options", "indices"), [
    ({0: 3.0}, [], list(range(20))),  # only the first stamp is wrong
    (dict.fromkeys(range(6, 20), -5.0), [], list(range(20))),  # the clock is set back
    (dict.fromkeys(range(6, 20), -5.0), ["--start", "0.4"], list(range(4, 20))),
    ({5: 60.0}, ["--duration", "1.0"], [0, 1, 2, 3, 4, 6, 7, 8, 9]),  # one stamp lies far ahead
])  # fmt: skip
def test_frames_with_wrong_stamps_are_not_dropped_in_silence(play, tmp_path: Path, back: dict[int, float], options: list[str], indices: list[int]) -> None:
    class Wrong(FakeRecording):
        def frames(self):
            for frame in FakeRecording.frames(self):
                yield replace(frame, stamp_ns=frame.stamp_ns + round(back.get(frame.index, 0.0) * 1e9))

    system, seen = FakeSystem(make_run("t" * 20)), []
    track = system.track
    system.track = lambda prepared: seen.append(prepared.frame.index) or track(prepared)  # type: ignore[method-assign]
    play(make_run("t" * 20), *options, recording=Wrong(tmp_path), system=system)
    assert seen == indices


def test_a_map_that_cannot_be_written_costs_no_other_result(play, tmp_path: Path) -> None:
    class Full(FakeSystem):
        def save_map(self, path: Path) -> None:
            raise InputError(f"cannot write {path}: No space left on device")

    result, out = play(make_run(), "--save-map", str(tmp_path / "hall.map"), system=Full(make_run()))
    assert result.exit_code == 2
    assert "No space left on device" in result.stderr
    for name in ("trajectory.txt", "metrics.json", "report.html"):
        assert (out / name).is_file(), name
    assert f"{json.loads((out / 'metrics.json').read_text())['tracked_pct']:g} %" in result.stdout


def test_a_map_is_no_folder(play, tmp_path: Path) -> None:
    result, out = play(make_run(), "--save-map", str(tmp_path))
    assert result.exit_code == 2
    assert "this is a folder; give the name of a file" in result.stderr
    assert not out.exists()


def test_a_part_without_frames_is_wrong_use(play) -> None:
    result, out = play(make_run(), "--start", "1000")
    assert result.exit_code == 2
    assert "no frame" in result.stderr
    assert not (out / "metrics.json").exists()


def test_options_reach_the_configuration(play, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("tracking: {min_inliers: 40}\nseed: 3\n")
    _, out = play(make_run(), "--profile", "fast", "--config", str(file), "--set", "tracking.min_reference_inliers=12", "--seed", "9")
    config = load_config(file=out / "config.yaml")
    assert (config.profile, config.seed, config.tracking.min_inliers, config.tracking.min_reference_inliers) == ("fast", 9, 40, 12)


def test_the_same_run_writes_the_same_bytes(play) -> None:
    _, out = play(make_run(noise=0.01))
    first = (out / "trajectory.txt").read_bytes()
    (out / "trajectory.txt").unlink()
    play(make_run(noise=0.01))
    assert (out / "trajectory.txt").read_bytes() == first


def test_unreadable_images_are_counted(play, tmp_path: Path) -> None:
    class Damaged(FakeRecording):
        def frames(self):
            for frame in FakeRecording.frames(self):
                if frame.index == 5:
                    self.problems["damaged png"] += 2
                yield frame

    recording = Damaged(tmp_path)
    recording.problems["damaged png"] += 2  # met when the recording was looked at before the run
    _, out = play(make_run(), recording=recording)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["bad_frames"] == {"damaged png": 2}
    assert metrics["frames_total"] == 22


# ---- interruptions ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("frames", [1, 8])
def test_interrupted_source_leaves_what_is_there(play, tmp_path: Path, frames: int) -> None:
    result, out = play(make_run("t" * 20), recording=FakeRecording(tmp_path, interrupt_at=frames))
    assert result.exit_code == 130
    assert len(read_tum(out / "trajectory.txt")) == frames
    assert json.loads((out / "metrics.json").read_text())["frames_total"] == frames
    assert (out / "report.html").is_file()
    assert "interrupted" in result.stdout


def test_ctrl_c_lets_the_frame_end(play) -> None:
    class Pressed(FakeSystem):
        def track(self, prepared):
            if prepared.frame.index == 6:
                signal.raise_signal(signal.SIGINT)
            return super().track(prepared)

    run, before = make_run("t" * 20), signal.getsignal(signal.SIGINT)
    result, out = play(run, system=Pressed(run))
    assert result.exit_code == 130
    assert len(read_tum(out / "trajectory.txt")) == 7
    assert signal.getsignal(signal.SIGINT) is before


def test_ctrl_c_while_finishing_still_writes(play) -> None:
    class Pressed(FakeSystem):
        def finish(self, progress=None):
            signal.raise_signal(signal.SIGINT)
            return super().finish(progress)

    run = make_run("t" * 20)
    result, out = play(run, system=Pressed(run))
    assert result.exit_code == 130
    assert len(read_tum(out / "trajectory.txt")) == 20


def test_second_ctrl_c_stops_at_once(play) -> None:
    class Pressed(FakeSystem):
        def finish(self, progress=None):
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            raise AssertionError("not reached")

    run = make_run("t" * 20)
    result, _ = play(run, system=Pressed(run))
    assert result.exit_code == 130
    assert "interrupted" in result.stderr


def test_a_source_that_fails_midway_leaves_what_is_there(play, tmp_path: Path) -> None:
    class Broken(FakeRecording):
        def frames(self):
            for frame in FakeRecording.frames(self):
                if frame.index == 9:
                    raise InputError("the disk went away")
                yield frame

    result, out = play(make_run("t" * 20), recording=Broken(tmp_path))
    assert result.exit_code == 2
    assert "the disk went away" in result.stderr
    assert len(read_tum(out / "trajectory.txt")) == 9


# ---- score, config, doctor --------------------------------------------------------------------------------------------------------


def test_score_as_table_and_json(tmp_path: Path, truth: Path) -> None:
    estimate = tmp_path / "estimate.txt"
    estimate.write_text(format_tum(make_trajectory((BEGIN_NS + i * PERIOD_NS, true_pose(i)) for i in range(10))))
    table = invoke("score", estimate, truth)
    assert table.exit_code == 0
    assert "50.00 % of 20 frames" in table.stdout
    figures = json.loads(invoke("score", estimate, truth, "--json").stdout)
    assert (figures["tracked_pct"], figures["pairs"]) == (50.0, 10)
    assert figures["ate_rmse"] == pytest.approx(0, abs=1e-7)


def test_score_says_why_it_cannot(tmp_path: Path, truth: Path) -> None:
    estimate = tmp_path / "estimate.txt"
    estimate.write_text("")
    result = invoke("score", estimate, truth)
    assert result.exit_code == 0
    assert "needs 3 frames with pose and ground truth, there are 0" in result.stdout


def test_config_lists_every_parameter_with_what_it_takes() -> None:
    rows = {row.key: row for row in parameters(load_config("fast"))}
    assert rows["extractor.name"].value == "xfeat"
    assert rows["extractor.max_keypoints"].takes == "integer >= 32 <= 8192"
    assert rows["tracking.max_view_angle_deg"].description == "degrees; paper: 60"
    assert len(rows) == sum(1 for _ in _leaves(ThegraConfig().model_dump()))
    output = invoke("config", "--profile", "fast").stdout
    for key in rows:
        assert key in output
    assert {row.key.strip() for row in filter_parameters()} >= {"chambolle_tv", "weight", "tail_fraction", "median"}


def test_config_yaml_is_read_back(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(invoke("config", "--profile", "paper", "--yaml").stdout)
    assert load_config(file=file) == load_config("paper")


def test_doctor_tells_versions_and_what_is_missing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("THEGRA_WEIGHTS", str(tmp_path))
    facts = json.loads(invoke("doctor", "--json").stdout)
    assert facts["packages"]["numpy"] == np.__version__
    assert set(facts["weights"]["files"].values()) == {"missing"}
    assert facts["cpus"] >= 1
    page = invoke("doctor")
    assert page.exit_code == 0
    assert "thegra weights fetch --profile quality" in page.stdout
    assert str(tmp_path) in page.stdout


def test_effective_configuration_is_yaml(play) -> None:
    _, out = play(replace(make_run(), losses=2))
    assert yaml.safe_load((out / "config.yaml").read_text())["run"]["input"]["name"] == "made"


def _leaves(values: dict, prefix: str = ""):
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}"


# ---- at the recording's own rate --------------------------------------------------------------------------------------------------


def test_a_recording_plays_at_its_own_rate(play, tmp_path: Path) -> None:
    run = make_run()
    system = FakeSystem(run)
    result, out = play(run, "--realtime", system=system)
    assert result.exit_code == 0, result.output
    assert system.warm and system.closed
    metrics = json.loads((out / "metrics.json").read_text())
    given = system.processed
    assert metrics["dropped_frames"] + given == len(run.frames) == metrics["frames_total"]
    assert metrics["wall_s"] > 0.9 * (len(run.frames) - 1) * PERIOD_NS / 1e9
    assert metrics["latency_ms"]["p50"] is not None and metrics["cpu_s_per_frame"] > 0


def test_without_haste_nothing_is_dropped_and_nothing_is_late(play) -> None:
    system = FakeSystem(make_run())
    result, out = play(make_run(), system=system)
    assert result.exit_code == 0 and system.closed and not system.warm
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["dropped_frames"] == 0 and metrics["latency_ms"] == {"p50": None, "p95": None, "p99": None}


def test_networks_from_a_cache_are_no_real_time(tmp_path: Path) -> None:
    result = invoke("run", tmp_path, "--realtime", "--cache", tmp_path / "cache")
    assert result.exit_code == 2 and "leave --cache out" in result.output
