"""Tables of poses whose layout nobody documents."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bag_making import T0
from dataset_making import rows, walk
from hypothesis import given, settings
from hypothesis import strategies as st

from thegra_core.errors import InputError
from thegra_core.evaluation.datasets.columns import by_names, quaternion_order
from thegra_core.evaluation.datasets.pose_table import read_pose_table
from thegra_core.outputs.trajectory import Trajectory


def same(read: Trajectory, truth: Trajectory, stamp_ns: int = 0) -> None:
    assert np.abs(read.stamps_ns - truth.stamps_ns).max() <= stamp_ns
    np.testing.assert_allclose(read.poses, truth.poses, atol=1e-6)


def table(file: Path, cells: np.ndarray, header: str = "", delimiter: str = ",") -> Path:
    file.write_text((header + "\n" if header else "") + "".join(delimiter.join(row) + "\n" for row in cells))
    return file


@pytest.mark.parametrize("delimiter", [",", " ", ";", "\t", ", "])
@pytest.mark.parametrize("time", ["s", "ns", "us", "ms"])
def test_units_and_delimiters(tmp_path: Path, delimiter: str, time: str) -> None:
    read = read_pose_table(table(tmp_path / "a.csv", rows(walk(upright=True), time=time), delimiter=delimiter))
    same(read.trajectory, walk(upright=True))
    assert f"({time} by magnitude)" in read.decision
    assert "x y z w: the body stays upright" in read.decision


@pytest.mark.parametrize(
    "header",
    [
        "timestamp,tx,ty,tz,qx,qy,qz,qw", "#time x y z qx qy qz qw".replace(" ", ","), "%time,field.pose.position.x,field.pose.position.y,field.pose.position.z,"
        "field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,field.pose.orientation.w",
        "Time [s],pos_x [m],pos_y [m],pos_z [m],rot_x,rot_y,rot_z,rot_w",
    ],
)  # fmt: skip
def test_headers(tmp_path: Path, header: str) -> None:
    read = read_pose_table(table(tmp_path / "a.csv", rows(walk()), header))
    same(read.trajectory, walk())
    assert "by the header" in read.decision


def test_a_header_tells_another_order(tmp_path: Path) -> None:
    header = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1], b_w_RS_S_x [rad s^-1]"
    cells = np.column_stack([rows(walk(), "wxyz", "ns"), np.full((20, 2), "7.5")])
    same(read_pose_table(table(tmp_path / "a.csv", cells, header)).trajectory, walk())


def test_seconds_and_nanoseconds_in_two_columns(tmp_path: Path) -> None:
    cells = rows(walk(), time="ns")
    times = [divmod(int(cell), 10**9) for cell in cells[:, 0]]
    cells = np.column_stack([np.arange(20).astype(str), [str(s) for s, _ in times], [str(ns) for _, ns in times], ["world"] * 20, cells[:, 1:]])
    names = "field.header.seq,field.header.stamp.secs,field.header.stamp.nsecs,frame_id,x,y,z,qx,qy,qz,qw"
    same(read_pose_table(table(tmp_path / "a.csv", cells, names)).trajectory, walk())


@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
def test_the_order_of_an_upright_body_is_told_by_its_numbers(tmp_path: Path, order: str) -> None:
    read = read_pose_table(table(tmp_path / "a.csv", rows(walk(upright=True), order)))
    same(read.trajectory, walk(upright=True))
    assert "assumed" not in read.decision


def test_an_order_that_nothing_tells_is_said_to_be_assumed(tmp_path: Path) -> None:
    read = read_pose_table(table(tmp_path / "a.csv", rows(walk())))
    same(read.trajectory, walk())
    assert "quaternion x y z w assumed" in read.decision


def test_quaternion_before_position_and_an_index(tmp_path: Path) -> None:
    cells = rows(walk(upright=True), "wxyz")
    cells = np.column_stack([np.arange(20).astype(str), cells[:, 0], cells[:, 4:], cells[:, 1:4]])
    same(read_pose_table(table(tmp_path / "a.txt", cells, delimiter=" ")).trajectory, walk(upright=True))


def test_matrices_with_and_without_time(tmp_path: Path) -> None:
    truth = walk()
    twelve = np.array([[f"{v:.9f}" for v in pose[:3].ravel()] for pose in truth.poses])
    same(read_pose_table(table(tmp_path / "a.txt", twelve, delimiter=" "), truth.stamps_ns).trajectory, truth)
    timed = np.column_stack([rows(truth)[:, 0], twelve])
    same(read_pose_table(table(tmp_path / "b.txt", timed, delimiter=" ")).trajectory, truth)
    with pytest.raises(InputError, match="20 poses but there are 3 stamps"):
        read_pose_table(tmp_path / "a.txt", truth.stamps_ns[:3])


def test_roll_pitch_yaw(tmp_path: Path) -> None:
    from scipy.spatial.transform import Rotation

    truth = walk()
    angles = Rotation.from_matrix(truth.poses[:, :3, :3]).as_euler("xyz")
    cells = np.column_stack([rows(truth)[:, :4], np.array([[f"{a:.9f}" for a in row] for row in angles])])
    same(read_pose_table(table(tmp_path / "a.csv", cells, "t,x,y,z,roll,pitch,yaw")).trajectory, truth)


def test_positions_alone_are_told(tmp_path: Path) -> None:
    read = read_pose_table(table(tmp_path / "a.csv", rows(walk())[:, :4]))
    np.testing.assert_allclose(read.trajectory.positions, walk().positions, atol=1e-6)
    assert "no orientation" in read.decision


def test_bad_rows_repeats_and_disorder_are_left_out_and_counted(tmp_path: Path) -> None:
    cells = rows(walk())
    lines = [",".join(row) for row in cells]
    (tmp_path / "a.csv").write_text("\n".join([*lines[10:], *lines[:10], lines[3], "half,a,line", lines[4].replace(cells[4][1], "nan")]))
    read = read_pose_table(tmp_path / "a.csv")
    same(read.trajectory, walk())
    assert "3 rows left out" in read.decision


def test_times_from_zero_are_said_to_be_relative(tmp_path: Path) -> None:
    read = read_pose_table(table(tmp_path / "a.csv", rows(walk(begin_ns=0))))
    assert "counted from its own beginning" in read.decision
    same(read.trajectory, walk(begin_ns=0))


@pytest.mark.parametrize("text", ["", "a,b,c\nd,e,f\n", "1,2\n3,4\n", "5,1,1\n5,1,1\n"])
def test_what_cannot_be_made_out_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=r"a\.csv"):
        read_pose_table(tmp_path / "a.csv")
    with pytest.raises(InputError, match="cannot read"):
        read_pose_table(tmp_path / "absent.csv")


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["s", "ns"]), st.integers(0, 2), st.integers(0, 2))
def test_any_upright_walk_is_read_whatever_stands_beside_it(tmp_path_factory: pytest.TempPathFactory, seed: int, time: str, extra: int, offset: int) -> None:
    rng, truth = np.random.default_rng(seed), walk(30, T0 + seed * 10**9, upright=True)
    truth.poses[:, :3, 3] += rng.normal(0, 5, 3)
    noise = rng.normal(0, 40, (30, extra)) + 100 * offset + 60
    cells = np.column_stack([rows(truth, time=time), np.array([[f"{v:.3f}" for v in row] for row in noise]).reshape(30, extra)])
    same(read_pose_table(table(tmp_path_factory.mktemp("t") / "a.csv", cells)).trajectory, truth)


def test_names_that_are_no_poses_are_not_taken_for_them() -> None:
    assert by_names(["time", "vx", "vy", "vz"]) is None or by_names(["time", "twist.linear.x", "twist.linear.y", "twist.linear.z"]) is None
    assert by_names(["time", "twist.linear.x", "twist.linear.y", "twist.linear.z"]) is None
    assert by_names(["x", "y", "z"]) is None


def test_custom_decides_where_numbers_do_not() -> None:
    mixed = np.full((10, 4), 0.5)
    assert quaternion_order(mixed, follows_position=True)[0] == "xyzw"
    assert quaternion_order(mixed, follows_position=False)[0] == "wxyz"
