"""TUM, EuRoC, KITTI and lists of one's own, in exactly these layouts."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from bag_making import T0, write_ros1
from dataset_making import PERIOD_NS, rows, thermal, transforms, walk

from thegra_core.errors import InputError
from thegra_core.evaluation.datasets.below import below
from thegra_core.evaluation.datasets.registry import DATASETS
from thegra_core.evaluation.datasets.sequence import Found, Options
from thegra_core.geometry.poses import so3_exp, transform
from thegra_core.outputs.trajectory import format_tum
from thegra_core.sources.calibration import load_camera
from thegra_core.sources.open import camera_for, open_recording

COUNT = 4
STAMPS = [T0 + i * PERIOD_NS for i in range(COUNT)]


def find(name: str, folder: Path, tmp_path: Path, **changed) -> Found:
    return DATASETS[name]([folder], Options(tmp_path / "work", **changed))


def png(file: Path, value: int) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(file), np.full((48, 64), value, np.uint8))


def readable(sequence) -> None:
    """As `thegra run` would read it."""
    recording = open_recording(sequence.recording, sequence.topic)
    frames = list(recording.frames())
    assert [f.stamp_ns for f in frames] == STAMPS
    assert [int(f.image[5, 5]) for f in frames] == list(range(COUNT))
    assert camera_for(recording, sequence.camera).image_size == (64, 48)


def test_tum(tmp_path: Path) -> None:
    home = tmp_path / "data" / "rgbd_dataset_freiburg2_desk"
    for i in range(COUNT):
        png(home / "rgb" / f"{i}.png", i)
    (home / "rgb.txt").write_text("# color images\n# file: 'x.bag'\n# timestamp filename\n" + "".join(f"{rows(walk(COUNT))[i][0]} rgb/{i}.png\n" for i in range(COUNT)))
    (home / "groundtruth.txt").write_text("# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n" + format_tum(walk()))
    (sequence,) = find("tum", tmp_path / "data", tmp_path).sequences
    assert sequence.name == "rgbd_dataset_freiburg2_desk"
    assert load_camera(sequence.camera).matrix[0, 0] == 520.9
    np.testing.assert_allclose(sequence.reference().trajectory.poses, walk().poses, atol=1e-6)
    (home / "camera.yaml").write_text("60 60 32 24 64 48\n")
    (sequence,) = find("tum", home, tmp_path).sequences
    readable(sequence)


SENSOR = """%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [{data}]
rate_hz: 20
resolution: [64, 48]
camera_model: pinhole
intrinsics: [60.0, 61.0, 32.0, 24.0]
distortion_model: {model}
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.7e-05]
"""


def make_euroc(home: Path, model: str = "radial-tangential") -> np.ndarray:
    arm = transform(so3_exp([0.1, -0.2, 1.5]), [0.05, -0.02, 0.1])
    for i, stamp in enumerate(STAMPS):
        png(home / "cam0" / "data" / f"{stamp}.png", i)
    (home / "cam0" / "data.csv").write_text("#timestamp [ns],filename\n" + "".join(f"{s},{s}.png\n" for s in STAMPS))
    (home / "cam0" / "sensor.yaml").write_text(SENSOR.format(data=", ".join(map(str, arm.ravel())), model=model))
    truth = home / "state_groundtruth_estimate0"
    truth.mkdir()
    header = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]"
    (truth / "data.csv").write_text(header + "\n" + "".join(",".join([*row, "1", "2", "3"]) + "\n" for row in rows(walk(), "wxyz", "ns")))
    return arm


def test_euroc_with_the_ground_truth_moved_to_the_camera(tmp_path: Path) -> None:
    arm = make_euroc(tmp_path / "data" / "MH_01_easy" / "mav0")
    (sequence,) = find("euroc", tmp_path / "data", tmp_path).sequences
    assert sequence.name == "MH_01_easy"
    readable(sequence)
    assert load_camera(sequence.camera).distortion[0] == -0.28
    reference = sequence.reference()
    np.testing.assert_allclose(reference.trajectory.poses, walk().poses @ arm, atol=1e-6)
    assert "moved to the camera by T_BS" in reference.source


def test_an_unknown_camera_model_costs_its_sequence_only(tmp_path: Path) -> None:
    make_euroc(tmp_path / "data" / "good" / "mav0")
    make_euroc(tmp_path / "data" / "odd" / "mav0", model="fov")
    found = find("euroc", tmp_path / "data", tmp_path)
    assert [s.name for s in found.sequences] == ["good"]
    assert "unknown distortion_model 'fov'" in found.missing[0].how_to_get


def test_inputs_that_did_not_change_are_not_written_again(tmp_path: Path) -> None:
    make_euroc(tmp_path / "data" / "a" / "mav0")
    files = [tmp_path / "work" / "a" / name for name in ("images.txt", "camera.yaml")]
    find("euroc", tmp_path / "data", tmp_path)
    before = [f.stat().st_ino for f in files]
    find("euroc", tmp_path / "data", tmp_path)
    assert [f.stat().st_ino for f in files] == before


def test_kitti(tmp_path: Path) -> None:
    data = tmp_path / "dataset"
    home = data / "sequences" / "07"
    truth = walk(COUNT, 0)
    for i in range(COUNT):
        png(home / "image_0" / f"{i:06d}.png", i)
    (home / "times.txt").write_text("".join(f"{i * PERIOD_NS / 1e9:.6e}\n" for i in range(COUNT)))
    (home / "calib.txt").write_text("P0: 60 0 32 0 0 61 24 0 0 0 1 0\nP1: 60 0 32 -5 0 61 24 0 0 0 1 0\n")
    (data / "poses").mkdir()
    (data / "poses" / "07.txt").write_text("".join(" ".join(f"{v:.9e}" for v in p[:3].ravel()) + "\n" for p in truth.poses))
    (sequence,) = find("kitti", data, tmp_path).sequences
    frames = list(open_recording(sequence.recording).frames())
    assert [f.stamp_ns for f in frames] == [i * PERIOD_NS for i in range(COUNT)]
    assert load_camera(sequence.camera).matrix[1, 1] == 61
    reference = sequence.reference().trajectory
    assert reference.stamps_ns.tolist() == truth.stamps_ns.tolist()
    np.testing.assert_allclose(reference.poses, truth.poses, atol=1e-6)
    (home / "times.txt").write_text("0.0\n")
    assert "4 images but 1 times" in find("kitti", data, tmp_path).missing[0].how_to_get


def test_a_list_of_ones_own(tmp_path: Path) -> None:
    write_ros1(tmp_path / "one.bag", thermal() + transforms("/vicon/rig", walk()))
    (tmp_path / "truth.csv").write_text("".join(",".join(row) + "\n" for row in rows(walk(upright=True))))
    (tmp_path / "list.yaml").write_text(
        "- {input: one.bag, topic: /thermal/image_raw, camera: cam.yaml, groundtruth: truth.csv}\n"
        "- {input: one.bag, name: two, groundtruth: /vicon/rig, start: 1, duration: 2.5}\n"
        "- {input: gone.bag}\n- {input: one.bag, name: three, groundtruth: gone.csv}\n"
    )  # fmt: skip
    found = find("generic", tmp_path / "list.yaml", tmp_path)
    assert [(s.name, s.topic, s.start_s, s.duration_s) for s in found.sequences] == [("one", "/thermal/image_raw", 0.0, None), ("two", None, 1.0, 2.5)]
    assert found.sequences[0].camera == str(tmp_path / "cam.yaml")
    np.testing.assert_allclose(found.sequences[0].reference().trajectory.poses, walk(upright=True).poses, atol=1e-6)
    np.testing.assert_allclose(found.sequences[1].reference().trajectory.poses, walk().poses, atol=1e-6)
    assert [(m.name, m.how_to_get.split()[0]) for m in found.missing] == [("gone", str(tmp_path / "gone.bag")), ("three", str(tmp_path / "gone.csv"))]


@pytest.mark.parametrize("text", ["input: a.bag\n", "- {inptu: a.bag}\n", "- {input: a.bag, duration: -1}\n", "[}\n"])
def test_a_list_that_is_none_is_refused_with_an_example(tmp_path: Path, text: str) -> None:
    (tmp_path / "list.yaml").write_text(text)
    with pytest.raises(InputError, match=r"input: flights/one\.bag"):
        find("generic", tmp_path / "list.yaml", tmp_path)


def test_data_behind_links_is_found_once(tmp_path: Path) -> None:
    there = tmp_path / "disk" / "deep"
    there.mkdir(parents=True)
    (there / "a.bag").touch()
    (there / "round").symlink_to(tmp_path / "disk")  # leads back
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "linked").symlink_to(there)
    (tmp_path / "data" / "again").symlink_to(there)
    found = [p for p in below([tmp_path / "data"]) if p.name == "a.bag"]
    assert len(found) == 1 and found[0].resolve() == there / "a.bag"


def test_names_must_differ(tmp_path: Path) -> None:
    write_ros1(tmp_path / "one.bag", thermal())
    (tmp_path / "list.yaml").write_text("- input: one.bag\n- input: one.bag\n")
    with pytest.raises(InputError, match="two recordings are called one"):
        find("generic", tmp_path / "list.yaml", tmp_path)


@pytest.mark.parametrize("name", ["tum", "euroc", "kitti"])
def test_an_empty_folder_is_refused_with_where_to_get_it(tmp_path: Path, name: str) -> None:
    (tmp_path / "data").mkdir()
    with pytest.raises(InputError, match=r"get them|get the"):
        find(name, tmp_path / "data", tmp_path)
