"""A simulated recording is read back as it was made, in every format, and is the same for the same seed."""

from __future__ import annotations

import hashlib
import itertools
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from thegra_core.cli.main import app
from thegra_core.errors import InputError
from thegra_core.outputs.trajectory import parse_stamp, read_tum
from thegra_core.simulation.paths import STYLES, HandHeldPath
from thegra_core.simulation.scenes import SCENES
from thegra_core.simulation.sensor_config import SensorConfig
from thegra_core.simulation.simulate import START_NS, SimulationOptions, rendered, simulate
from thegra_core.simulation.writers import WRITERS
from thegra_core.sources.calibration import load_camera
from thegra_core.sources.open import all_topics, camera_for, image_topics, open_recording
from thegra_core.sources.summary import summarize

SMALL = SimulationOptions(duration_s=0.6, image_size=(80, 64))


def digest(folder: Path) -> str:
    total = hashlib.sha256()
    for file in sorted(f for f in folder.rglob("*") if f.is_file()):
        total.update(file.relative_to(folder).as_posix().encode() + file.read_bytes())
    return total.hexdigest()


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_every_format_is_read_back_as_it_was_made(tmp_path: Path, name: str) -> None:
    lens = "tau2" if name == "rovtio" else "a65"
    made = rendered(SMALL, lens)
    ticks = list(made.ticks)
    recording = open_recording(simulate(SMALL, tmp_path / "out", name))
    frames = list(recording.frames())
    assert [frame.stamp_ns for frame in frames] == [tick.stamp_ns for tick in ticks]
    assert all(np.array_equal(frame.image, tick.image) and frame.image.dtype == np.uint16 for frame, tick in zip(frames, ticks, strict=True))
    assert not recording.problems
    camera = camera_for(recording)
    assert np.allclose(camera.matrix, made.camera.matrix) and np.allclose(camera.distortion, made.camera.distortion) and camera.model is made.camera.model
    truth = read_tum(recording.groundtruth)
    assert truth.stamps_ns.tolist() == [tick.stamp_ns for tick in ticks]
    assert np.allclose(truth.poses, [tick.world_from_camera for tick in ticks], atol=1e-8)


def test_stamps_have_the_rate_asked_for(tmp_path: Path) -> None:
    folder = simulate(SMALL.model_copy(update={"rate_hz": 12.5, "duration_s": 0.4}), tmp_path / "out", "folder")
    assert [frame.stamp_ns - START_NS for frame in open_recording(folder).frames()] == [0, 80_000_000, 160_000_000, 240_000_000, 320_000_000]


def test_same_seed_same_bytes_and_another_seed_other_images(tmp_path: Path) -> None:
    made = [simulate(SMALL.model_copy(update={"seed": seed}), tmp_path / str(k), "folder") for k, seed in enumerate((5, 5, 6))]
    assert digest(made[0]) == digest(made[1]) != digest(made[2])


def test_what_is_there_is_not_overwritten(tmp_path: Path) -> None:
    simulate(SMALL.model_copy(update={"duration_s": 0.1}), tmp_path / "out")
    with pytest.raises(InputError, match="exists already"):
        simulate(SMALL, tmp_path / "out")


def test_a_folder_that_cannot_be_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for form in ("mcap", "folder"):
        with pytest.raises(InputError, match=r"cannot write to .*file: (Not a directory|File exists)"):
            simulate(SMALL.model_copy(update={"duration_s": 0.1}), tmp_path / "file" / "out", form)


def test_progress_counts_to_the_end(tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    simulate(SMALL.model_copy(update={"duration_s": 0.5}), tmp_path / "out", "folder", lambda done, total: calls.append((done, total)))
    assert calls == [(done, 5) for done in range(6)]


@pytest.mark.parametrize("shutter", ["gap", "freeze"])
def test_a_closed_shutter_leaves_a_gap_or_repeats_the_last_image_bit_for_bit(tmp_path: Path, shutter: str) -> None:
    options = SMALL.model_copy(update={"shutter": shutter, "duration_s": 2.5, "image_size": (40, 32)})
    folder = simulate(options, tmp_path / "out", "folder")
    ((begin, end),) = (tuple(parse_stamp(text) for text in line.split()) for line in (folder / "shutter.txt").read_text().splitlines())
    assert end - begin == 900_000_000
    frames = list(open_recording(folder).frames())
    inside = [frame for frame in frames if begin <= frame.stamp_ns < end]
    outside = [frame for frame in frames if not begin <= frame.stamp_ns < end]
    assert len(outside) == 16 and outside[-1].stamp_ns - outside[0].stamp_ns == 2_400_000_000
    if shutter == "gap":
        assert inside == []
    else:
        last = next(frame for frame in reversed(outside) if frame.stamp_ns < begin)
        assert len(inside) == 9 and all(np.array_equal(frame.image, last.image) for frame in inside)
    assert not any(np.array_equal(a.image, b.image) for a, b in itertools.pairwise(outside))
    assert len(read_tum(folder / "groundtruth.txt")) == 25, "ground truth goes on"
    spans = summarize(open_recording(folder)).closures
    assert len(spans) == 1


def test_ground_truth_holds_at_the_stamp_however_it_jitters(tmp_path: Path) -> None:
    jittering = SMALL.model_copy(update={"sensor": SensorConfig(stamp_jitter_us=5000), "image_size": (40, 32)})
    kind = SCENES["room"]
    path = HandHeldPath(kind.route(), STYLES["robust"], 0.6, 0)
    for tick in rendered(jittering).ticks:
        assert np.allclose(tick.world_from_camera, path.pose((tick.stamp_ns - START_NS) * 1e-9), atol=1e-9)


def test_an_existing_recording_passes_through_the_sensor(tmp_path: Path) -> None:
    quiet = SensorConfig(optics_blur_px=0, netd_mk=0, pattern_netd=0, column_netd=0, pattern_growth=0, offset_drift_k=0, dome_k_per_min=0, offset_jump_k=0, dead_pixels=0)
    first = simulate(SMALL.model_copy(update={"sensor": quiet}), tmp_path / "first", "folder")
    again = simulate(SimulationOptions(source=first, sensor=quiet), tmp_path / "again")
    noisy = simulate(SimulationOptions(source=first, sensor=quiet.model_copy(update={"netd_mk": 100.0})), tmp_path / "noisy", "folder")
    before, after, noise = (list(open_recording(folder).frames()) for folder in (first, again, noisy))
    level = 7000.0 - float(np.median(before[0].image))
    assert [frame.stamp_ns for frame in after] == [frame.stamp_ns for frame in before]
    for a, b, c in zip(before, after, noise, strict=True):
        assert np.abs(b.image - (a.image + level)).max() <= 0.5
        assert np.std(c.image.astype(float) - b.image) == pytest.approx(0.1 * 40, rel=0.05)
    assert np.allclose(read_tum(again / "groundtruth.txt").poses, read_tum(first / "groundtruth.txt").poses)
    assert np.allclose(camera_for(open_recording(again)).matrix, camera_for(open_recording(first)).matrix)


def test_sets_look_like_the_public_ones(tmp_path: Path) -> None:
    bag = simulate(SMALL.model_copy(update={"style": "aggressive"}), tmp_path / "vivid", "vivid")
    names = {file.relative_to(tmp_path / "vivid").as_posix() for file in (tmp_path / "vivid").rglob("*") if file.is_file()}
    assert bag == tmp_path / "vivid/handheld_indoor/dark_aggresive.bag"
    assert {"handheld_indoor/pose/indoor_aggresive_dark_gt.csv", "calibration/handheld_results/camchain-therrgb.yaml"} <= names
    assert {topic for topic, _, _ in all_topics(bag)} == {"/thermal/image_raw", "/thermal/camera_info"}
    kalibr = load_camera(tmp_path / "vivid/calibration/handheld_results/camchain-therrgb.yaml", "cam0", (80, 64))
    assert np.allclose(kalibr.distortion, camera_for(open_recording(bag)).distortion)


def test_rovtio_is_split_into_numbered_bags(tmp_path: Path) -> None:
    options = SMALL.model_copy(update={"duration_s": 61.0, "rate_hz": 1.0, "image_size": (16, 12)})
    folder = simulate(options, tmp_path / "lt1", "rovtio")
    assert [bag.name.rpartition("_")[2] for bag in sorted(folder.glob("m100_charlie_2021-06-09-23-*.bag"))] == ["0.bag", "1.bag", "2.bag"]
    assert {topic for topic, _, _ in all_topics(folder)} == {"/tau_nodelet/thermal_image", "/aft_mapped_to_init_CORRECTED", "/vicon/charlie/charlie"}
    assert image_topics(folder)[0].encoding == "16UC1"
    assert len(list(open_recording(folder).frames())) == 61


def invoke(*arguments: str | Path):
    return CliRunner().invoke(app, ["simulate", *(str(argument) for argument in arguments)], env={"COLUMNS": "250", "TERM": "dumb"})


def test_the_command_makes_what_it_says_and_tells_what_to_run(tmp_path: Path) -> None:
    result = invoke("--duration", "0.3", "--size", "40x32", "--rate", "10", "--set", "netd_mk=0", "--set", "sensor.agc=linear", "--format", "folder", "--out", tmp_path / "out")
    assert result.exit_code == 0 and f"thegra run {tmp_path / 'out'}" in result.stdout
    frames = list(open_recording(tmp_path / "out").frames())
    assert len(frames) == 3 and frames[0].image.shape == (32, 40) and frames[0].image.dtype == np.uint8


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--size", "640"), "--size 640x512"),
        (("--scene", "moon"), "scene"),
        (("--set", "netd=4"), "netd"),
        (("--set", "netd_mk"), "KEY=VALUE"),
        (("--format", "avi"), "mcap, vivid, rovtio, folder"),
        (("--from", "nowhere"), "nowhere does not exist"),
    ],
)
def test_wrong_options_say_what_to_type(tmp_path: Path, arguments: tuple[str, str], told: str) -> None:
    result = invoke(*arguments, "--out", tmp_path / "out")
    assert result.exit_code == 2 and told in result.output and not (tmp_path / "out").exists()


def test_without_embree_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    with pytest.raises(InputError, match="pip install trimesh embreex"):
        simulate(SMALL, tmp_path / "out")
