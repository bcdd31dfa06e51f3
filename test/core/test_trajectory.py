from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_runs import BEGIN_NS, PERIOD_NS, make_run, true_pose

from thegra_core.errors import InputError
from thegra_core.geometry.poses import so3_exp
from thegra_core.outputs.trajectory import (
    final_trajectory,
    format_stamp,
    format_tum,
    keyframe_trajectory,
    live_trajectory,
    make_trajectory,
    parse_stamp,
    predicted_trajectory,
    read_tum,
)


@pytest.mark.parametrize(
    ("stamp_ns", "text"),
    [
        (0, "0.000000000"),
        (1, "0.000000001"),
        (1_700_000_000_123_456_789, "1700000000.123456789"),  # not representable as a double
        (999_999_999, "0.999999999"),
        (-1_500_000_000, "-1.500000000"),
    ],
)
def test_stamps_are_exact(stamp_ns: int, text: str) -> None:
    assert format_stamp(stamp_ns) == text
    assert parse_stamp(text) == stamp_ns


@given(st.integers(min_value=-(2**62), max_value=2**62))
def test_every_stamp_survives_the_round_trip(stamp_ns: int) -> None:
    assert parse_stamp(format_stamp(stamp_ns)) == stamp_ns


@pytest.mark.parametrize(("text", "stamp_ns"), [("1.7e9", 1_700_000_000_000_000_000), ("5", 5_000_000_000), ("0.1", 100_000_000), (".5", 500_000_000)])
def test_stamps_in_other_forms(text: str, stamp_ns: int) -> None:
    assert parse_stamp(text) == stamp_ns


@pytest.mark.parametrize("text", ["", "abc", "nan", "inf", "1e30"])
def test_what_is_no_stamp_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="time in seconds"):
        parse_stamp(text)


@given(
    st.lists(st.floats(-3.1, 3.1), min_size=3, max_size=3).map(np.array),
    st.lists(st.floats(-1e4, 1e4), min_size=3, max_size=3).map(np.array),
)
def test_poses_survive_the_round_trip(rotation_vector: np.ndarray, position: np.ndarray) -> None:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = so3_exp(rotation_vector), position
    line = format_tum(make_trajectory([(BEGIN_NS, pose)]))
    values = np.array([float(word) for word in line.split()])
    assert np.linalg.norm(values[4:]) == pytest.approx(1, abs=1e-8)
    assert values[7] >= 0
    from thegra_core.geometry.poses import rotation_from_quaternion

    np.testing.assert_allclose(rotation_from_quaternion(values[4:]), pose[:3, :3], atol=1e-7)
    np.testing.assert_allclose(values[1:4], position, atol=1e-9)


def test_half_turns_have_one_sign() -> None:
    pose = np.eye(4)
    for axis in np.eye(3):
        pose[:3, :3] = so3_exp(np.pi * axis)
        forwards = format_tum(make_trajectory([(0, pose)]))
        pose[:3, :3] = so3_exp(-np.pi * axis)
        assert format_tum(make_trajectory([(0, pose)])) == forwards
        assert "-" not in forwards


def test_reading_takes_commas_comments_and_any_order(tmp_path: Path) -> None:
    file = tmp_path / "t.txt"
    file.write_text("# timestamp tx ty tz qx qy qz qw\n\n2.5, 1, 2, 3, 0, 0, 0, 2\n1.000000001 4 5 6 0 0 0 -1  # a comment\n")
    trajectory = read_tum(file)
    assert trajectory.stamps_ns.tolist() == [1_000_000_001, 2_500_000_000]
    np.testing.assert_array_equal(trajectory.positions, [[4, 5, 6], [1, 2, 3]])
    np.testing.assert_allclose(trajectory.poses[:, :3, :3], [np.eye(3)] * 2)


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("1 2 3", "t.txt:2: 3 columns"),
        ("1 2 3 4 5 6 7 x", "t.txt:2: .*'x'"),
        ("one 2 3 4 0 0 0 1", "t.txt:2: 'one' is no time"),
        ("1 nan 3 4 0 0 0 1", "t.txt:2: a value is not finite"),
        ("1 2 3 4 0 0 0 0", "t.txt:2: the quaternion is zero"),
    ],
)
def test_errors_name_the_line(tmp_path: Path, line: str, told: str) -> None:
    file = tmp_path / "t.txt"
    file.write_text(f"0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(InputError, match=told):
        read_tum(file)


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"absent.txt: No such file"):
        read_tum(tmp_path / "absent.txt")
    binary = tmp_path / "map.ply"
    binary.write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(InputError, match=r"map.ply is no text file"):
        read_tum(binary)


def test_an_empty_file_is_an_empty_trajectory(tmp_path: Path) -> None:
    file = tmp_path / "t.txt"
    file.write_text("# nothing tracked\n")
    assert read_tum(file).poses.shape == (0, 4, 4)
    assert format_tum(read_tum(file)) == ""


def test_each_trajectory_of_a_run_holds_its_own_frames() -> None:
    run = make_run("iittthhlttt", localized=(1,), other_map_from=9)
    assert _indices(final_trajectory(run, 0)) == [1, 2, 3, 4, 8]
    assert _indices(live_trajectory(run, 0)) == [2, 3, 4, 8]  # frame 1 was localised afterwards: nobody had its pose at the time
    assert _indices(final_trajectory(run, 1)) == [9, 10]
    assert _indices(predicted_trajectory(run, 0)) == [5, 6]
    assert len(predicted_trajectory(run, 1)) == 0
    assert _indices(keyframe_trajectory(run, 0)) == [1, 4]
    assert len(keyframe_trajectory(run, 7)) == 0


def test_live_poses_are_not_the_final_ones() -> None:
    run = make_run("ttttt", noise=0.1)
    assert not np.allclose(final_trajectory(run, 0).poses, live_trajectory(run, 0).poses)
    np.testing.assert_array_equal(live_trajectory(run, 0).poses[2], run.frames[2].result.world_from_camera)


def test_frames_are_sorted_by_time() -> None:
    trajectory = make_trajectory([(3, true_pose(3)), (1, true_pose(1)), (2, true_pose(2))])
    assert trajectory.stamps_ns.tolist() == [1, 2, 3]
    np.testing.assert_array_equal(trajectory.poses[0], true_pose(1))


def _indices(trajectory) -> list[int]:
    return ((trajectory.stamps_ns - BEGIN_NS) // PERIOD_NS).tolist()
