"""ViViD++ and ROVTIO: the files by all their names, topics by type, references by what is there."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from bag_making import T0, write_ros1
from dataset_making import PERIOD_NS, odometry, rows, thermal, transforms, walk

from thegra_core.errors import InputError
from thegra_core.evaluation.datasets.rovtio import LOAM, VICON, find_rovtio, in_order
from thegra_core.evaluation.datasets.sequence import DataSequence, Found, Options
from thegra_core.evaluation.datasets.vivid import SEQUENCES, find_vivid, key_of
from thegra_core.geometry.camera import DistortionModel
from thegra_core.sources.calibration import load_camera
from thegra_core.sources.open import open_recording


def options(tmp_path: Path, **changed) -> Options:
    return Options(tmp_path / "work", **changed)


def named(found: Found, name: str) -> DataSequence:
    return next(s for s in found.sequences if s.name == name)


def csv(file: Path, trajectory=None, **form) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("".join(",".join(row) + "\n" for row in rows(trajectory or walk(upright=True), **form)))
    return file


# ---- ViViD++ ----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("dark_aggresive", ("dark", "aggressive")), ("dark_aggressive", ("dark", "aggressive")), ("indoor_aggresive_dark_gt", ("dark", "aggressive")),
        ("indoor_aggressive_dark", ("dark", "aggressive")), ("Global-Aggressive", ("global", "aggressive")), ("local_robust", ("local", "robust")),
        ("indoor_robust_varying_gt", ("varying", "robust")), ("outdoor_robust_day1", ("day1", "robust")), ("path_outdoor_robust_night2", ("night2", "robust")),
        ("robust_night_1", ("night1", "robust")), ("dark_agressive", ("dark", "aggressive")), ("handheld_indoor_unstable_global", ("global", "unstable")),
        ("dark", None), ("varying_unstable", None), ("campus_day1_robust_driving", None), ("dark_robust_unstable", None), ("map_outdoor_robust_day1", None), ("day3_robust", None),
    ],
)  # fmt: skip
def test_names_in_every_spelling(name: str, key: tuple[str, str] | None) -> None:
    assert key_of(name) == key


MAILED = [
    "dark_aggresive", "dark_robust", "dark_unstable", "global_aggresive", "global_robust", "global_unstable", "local_aggressive", "local_robust", "local_unstable", "varying_robust",
]  # fmt: skip
OUTDOOR = ["outdoor_robust_day1", "outdoor_robust_day2", "outdoor_robust_night1", "outdoor_robust_night2"]


def make_vivid(root: Path, indoor: list[str], outdoor: list[str], truth: bool = True) -> Path:
    for folder, names in (("handheld_indoor", indoor), ("handheld_outdoor", outdoor)):
        (root / folder).mkdir(parents=True)
        for name in names:
            write_ros1(root / folder / f"{name}.bag", thermal() + thermal("/depth/image_raw", 5))
            light, motion = key_of(name)
            table = f"path_{name}.csv" if folder.endswith("outdoor") else f"indoor_{motion.replace('ss', 's')}_{light}_gt.csv"
            if truth:
                csv(root / folder / "pose" / table, time="ns")
    return root


def test_all_fourteen_are_found_by_the_mailed_names(tmp_path: Path) -> None:
    found = find_vivid([make_vivid(tmp_path / "v", MAILED, OUTDOOR)], options(tmp_path))
    assert [s.name for s in found.sequences] == list(SEQUENCES.values())
    assert found.missing == ()
    assert {s.topic for s in found.sequences} == {"/thermal/image_raw"}
    for sequence in found.sequences:
        reference = sequence.reference()
        assert (reference.trajectory.stamps_ns == walk().stamps_ns).all()
        np.testing.assert_allclose(reference.trajectory.poses, walk(upright=True).poses, atol=1e-6)
        assert reference.source.startswith("LOAM table path_outdoor" if "outdoor" in sequence.name else "Vicon table indoor_")
        assert "(ns by magnitude)" in reference.source
    camera = load_camera(found.sequences[0].camera)
    assert (camera.model, camera.image_size) == (DistortionModel.PLUMB_BOB, (640, 512))
    assert camera.focal == pytest.approx(437.3, abs=0.1)


def test_the_names_of_the_site_and_of_the_old_release_are_the_same_sequences(tmp_path: Path) -> None:
    site = ["dark_aggresive", "global_aggressive", "indoor_robust_local", "indoor_aggresive_local"]
    found = find_vivid([make_vivid(tmp_path / "v", site, [])], options(tmp_path))
    assert [s.name for s in found.sequences] == ["dark_aggresive", "global_aggresive", "local_aggressive", "local_robust"]


def test_missing_ones_are_named_with_how_to_get_them(tmp_path: Path) -> None:
    found = find_vivid([make_vivid(tmp_path / "v", ["dark_robust"], [])], options(tmp_path))
    assert [m.name for m in found.missing] == [name for name in SEQUENCES.values() if name != "dark_robust"]
    assert "global_unstable.bag" in next(m.how_to_get for m in found.missing if m.name == "global_unstable")
    assert "visibilitydataset.github.io" in found.missing[0].how_to_get


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "flight.bag").write_bytes(b"")
    with pytest.raises(InputError, match=r"no sequence of ViViD\+\+ .* dark_robust\.bag"):
        find_vivid([tmp_path], options(tmp_path))


def test_the_topic_is_found_by_type_and_encoding(tmp_path: Path) -> None:
    write_ros1(tmp_path / "dark_robust.bag", thermal("/rgb/image", encoding="8UC2", count=9) + thermal("/camera7/raw", encoding="16UC1") + thermal("/depth/image_raw", 30))
    write_ros1(tmp_path / "dark_unstable.bag", thermal("/rgb/image", encoding="8UC2") + thermal("/depth/image_raw"))
    found = find_vivid([tmp_path], options(tmp_path))
    assert named(found, "dark_robust").topic == "/camera7/raw"
    assert "known names are /thermal/image_raw" in named(found, "dark_robust").notes[0]
    refused = next(m for m in found.missing if m.name == "dark_unstable")
    assert "no topic of 16-bit single-channel images" in refused.how_to_get
    assert "/rgb/image" in refused.how_to_get


def test_the_image_size_decides_before_the_name(tmp_path: Path) -> None:
    write_ros1(tmp_path / "dark_robust.bag", thermal("/thermal/image_raw") + thermal("/other", count=1, size=(640, 512)))
    assert find_vivid([tmp_path], options(tmp_path)).sequences[0].topic == "/other"


def test_without_a_table_poses_in_the_bag_are_the_reference(tmp_path: Path) -> None:
    write_ros1(tmp_path / "dark_robust.bag", thermal() + transforms("/vicon/rig", walk()))
    write_ros1(tmp_path / "dark_unstable.bag", thermal())
    found = find_vivid([tmp_path], options(tmp_path))
    reference = named(found, "dark_robust").reference()
    np.testing.assert_allclose(reference.trajectory.poses, walk().poses, atol=1e-9)
    assert "/vicon/rig, 20 poses at 25 Hz, body 'charlie'" in reference.source
    assert named(found, "dark_unstable").reference is None
    assert "indoor_unstable_dark_gt.csv" in named(found, "dark_unstable").notes[-1]


def test_millimetres_indoors_are_told_by_their_size(tmp_path: Path) -> None:
    write_ros1(tmp_path / "dark_robust.bag", thermal())
    big = walk(upright=True)
    big.poses[:, :3, 3] *= 1000
    csv(tmp_path / "indoor_robust_dark_gt.csv", big)
    reference = find_vivid([tmp_path], options(tmp_path)).sequences[0].reference()
    np.testing.assert_allclose(reference.trajectory.positions, walk().positions, atol=1e-6)
    assert "millimetres by magnitude" in reference.source


def test_optimised_poses_with_times_in_a_file_of_their_own(tmp_path: Path) -> None:
    write_ros1(tmp_path / "outdoor_robust_day1.bag", thermal())
    truth = walk()
    (tmp_path / "outdoor_robust_day1_optimized_poses.txt").write_text("".join(" ".join(f"{v:.9f}" for v in p[:3].ravel()) + "\n" for p in truth.poses))
    (tmp_path / "outdoor_robust_day1_times.txt").write_text("".join(f"{row[0]}\n" for row in rows(truth, time="ns")))
    reference = find_vivid([tmp_path], options(tmp_path)).sequences[0].reference()
    assert (reference.trajectory.stamps_ns == truth.stamps_ns).all()
    np.testing.assert_allclose(reference.trajectory.poses, truth.poses, atol=1e-6)


def test_a_calibration_beside_the_bags_wins_over_ours(tmp_path: Path) -> None:
    root = make_vivid(tmp_path / "v", ["dark_robust"], [], truth=False)
    chain = root / "calibration" / "handheld_results" / "camchain-therrgb.yaml"
    chain.parent.mkdir(parents=True)
    chain.write_text("cam0: {}\n")
    assert find_vivid([root], options(tmp_path)).sequences[0].camera == f"{chain}:cam0"
    assert find_vivid([root], options(tmp_path, camera="mine.yaml")).sequences[0].camera == "mine.yaml"


def test_the_post_processed_release(tmp_path: Path) -> None:
    folder = tmp_path / "KAIST" / "indoor_robust_dark"
    (folder / "Thermal" / "data").mkdir(parents=True)
    truth = walk(4, 1_543_000_000 * 10**9)
    for i in range(4):
        cv2.imwrite(str(folder / "Thermal" / "data" / f"{i + 1:06d}.png"), np.full((48, 64), 3000 + i, np.uint16))
    times = ["2018-11-24 04:06:40.0", "2018-11-24 04:06:40.04", "2018-11-24 04:06:40.080000", "2018-11-24 04:06:40.12"]
    (folder / "Thermal" / "timestamps.txt").write_text("\n".join(times))
    (folder / "poses_thermal.txt").write_text("".join(" ".join(f"{v:.9f}" for v in p[:3].ravel()) + "\n" for p in truth.poses))
    sequence = find_vivid([tmp_path / "KAIST"], options(tmp_path)).sequences[0]
    assert (sequence.name, sequence.topic) == ("dark_robust", None)
    frames = list(open_recording(sequence.recording).frames())
    assert [f.stamp_ns for f in frames] == truth.stamps_ns.tolist()
    assert [int(f.image[0, 0]) for f in frames] == [3000, 3001, 3002, 3003]
    np.testing.assert_allclose(sequence.reference().trajectory.poses, truth.poses, atol=1e-6)


# ---- ROVTIO -----------------------------------------------------------------------------------------------------------------------

TAU = "/tau_nodelet/thermal_image"


def make_rovtio(root: Path, name: str = "alt1", bags: int = 12, with_loam: bool = True, with_vicon: bool = False, stamps: str = "2021-06-09-23-{:02d}-00") -> list[Path]:
    """Split bags of five frames each; the number in their names counts, their dates do not."""
    (root / name).mkdir(parents=True)
    files = []
    for i in range(bags):
        begin = T0 + i * 5 * PERIOD_NS
        items = thermal(TAU, 5, begin, encoding="16UC1")
        items += odometry(LOAM, walk(5, begin)) if with_loam else []
        items += transforms(VICON, walk(2, begin)) if with_vicon else []
        files.append(write_ros1(root / name / f"m100_charlie_{stamps.format(59 - i)}_{i}.bag", items))
    return files


def test_split_bags_follow_their_numbers(tmp_path: Path) -> None:
    files = make_rovtio(tmp_path)
    assert in_order(sorted(files)) == files
    assert in_order([Path("b.bag"), Path("x_10.bag"), Path("x_9.bag"), Path("a.bag")]) == [Path("x_9.bag"), Path("x_10.bag"), Path("a.bag"), Path("b.bag")]


def test_a_run_a_bag_file(tmp_path: Path) -> None:
    files = make_rovtio(tmp_path / "r")
    found = find_rovtio([tmp_path / "r"], options(tmp_path))
    assert [s.recording for s in found.sequences] == files
    assert [s.name for s in found.sequences] == [f"alt1_{i:02d}" for i in range(12)]
    assert {(s.row, s.topic) for s in found.sequences} == {("alt1", TAU)}
    assert [m.name for m in found.missing] == ["alt2", "sync", "lt1", "lt2", "lt3"]
    assert "lt2.zip" in found.missing[3].how_to_get
    reference = found.sequences[3].reference()
    assert reference.source.startswith(f"LOAM {LOAM}, 15 poses at 25 Hz")
    assert reference.trajectory.stamps_ns[0] == T0 + 10 * PERIOD_NS  # one bag before and one after
    camera = load_camera(found.sequences[0].camera)
    assert camera.model is DistortionModel.EQUIDISTANT


def test_the_folder_of_one_sequence_may_be_given_itself(tmp_path: Path) -> None:
    make_rovtio(tmp_path, "lt2", 2)
    assert [s.name for s in find_rovtio([tmp_path / "lt2"], options(tmp_path)).sequences] == ["lt2_00", "lt2_01"]


def test_whole_recordings_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    make_rovtio(tmp_path / "r", bags=11)
    (sequence,) = find_rovtio([tmp_path / "r"], options(tmp_path, pieces="whole")).sequences
    stamps = [f.stamp_ns for f in open_recording(sequence.recording, sequence.topic).frames()]
    assert stamps == [T0 + i * PERIOD_NS for i in range(55)]
    assert len(sequence.reference().trajectory) == 55
    assert sequence.name == sequence.row == "alt1"


def test_windows_cover_the_recording(tmp_path: Path) -> None:
    make_rovtio(tmp_path / "r", bags=2)
    short = options(tmp_path, pieces="windows", window_s=0.2)
    sequences = find_rovtio([tmp_path / "r"], short).sequences
    assert [(s.start_s, s.duration_s) for s in sequences] == [(0.0, 0.2)]  # what is left is under five seconds
    write_ros1(tmp_path / "r" / "alt1" / "m100_2.bag", thermal(TAU, 1, T0 + 70 * 10**9))
    sequences = find_rovtio([tmp_path / "r"], options(tmp_path, pieces="windows")).sequences
    assert [(s.start_s, s.duration_s, s.name) for s in sequences] == [(0.0, 30.0, "alt1_00"), (30.0, 30.0, "alt1_01"), (60.0, 30.0, "alt1_02")]


@pytest.mark.parametrize(
    ("choice", "loam", "vicon", "told"),
    [
        ("auto", True, True, "reference LOAM /aft_mapped_to_init_CORRECTED, /vicon/charlie/charlie (Vicon) is there, too: --reference vicon"),
        ("auto", False, True, "reference Vicon /vicon/charlie/charlie"), ("vicon", True, True, "reference Vicon /vicon/charlie/charlie"), ("loam", False, True, None), ("auto", False, False, None),
    ],
)  # fmt: skip
def test_which_reference_is_used_is_told(tmp_path: Path, choice: str, loam: bool, vicon: bool, told: str | None) -> None:
    make_rovtio(tmp_path / "r", "sync", 1, with_loam=loam, with_vicon=vicon)
    (sequence,) = find_rovtio([tmp_path / "r"], options(tmp_path, reference=choice)).sequences
    if told is None:
        assert sequence.reference is None
        assert any("no ground truth" in note for note in sequence.notes)
    else:
        assert told in sequence.notes
        assert sequence.reference().source.startswith(told.split()[1])


def test_a_folder_without_recordings_is_refused(tmp_path: Path) -> None:
    (tmp_path / "alt1").mkdir()
    with pytest.raises(InputError, match="no recording of ROVTIO"):
        find_rovtio([tmp_path], options(tmp_path))


def test_a_damaged_bag_costs_its_sequence_only(tmp_path: Path) -> None:
    make_rovtio(tmp_path / "r", "lt1", 1)
    (tmp_path / "r" / "lt2").mkdir()
    (tmp_path / "r" / "lt2" / "x_0.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    found = find_rovtio([tmp_path / "r"], options(tmp_path))
    assert [s.row for s in found.sequences] == ["lt1"]
    assert "x_0.bag" in next(m.how_to_get for m in found.missing if m.name == "lt2")
