"""Rotations and rigid transforms against scipy and pytransform3d."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pytransform3d import rotations, transformations
from scipy.spatial.transform import Rotation

from thegra_core.geometry import poses

vectors = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(np.array)
seeds = st.integers(0, 2**32 - 1)


def random_pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return poses.transform(Rotation.random(random_state=seed % 2**31).as_matrix(), rng.normal(size=3))


@settings(deadline=None)
@given(vectors)
def test_exponential_is_scipys(vector: np.ndarray) -> None:
    np.testing.assert_allclose(poses.so3_exp(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)


@settings(deadline=None)
@given(seeds)
def test_logarithm_is_scipys(seed: int) -> None:
    rotation = Rotation.random(random_state=seed % 2**31)
    np.testing.assert_allclose(poses.so3_log(rotation.as_matrix()), rotation.as_rotvec(), atol=1e-9)
    assert poses.rotation_angle(rotation.as_matrix()) == pytest.approx(rotation.magnitude(), abs=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 1e-8, 1.01e-8, 1e-6, 1e-3, np.pi - 1e-9, np.pi])
@pytest.mark.parametrize("axis", [[1.0, 0, 0], [0, -1.0, 0], [0.6, 0, -0.8], [-0.48, 0.6, 0.64]])
def test_small_and_half_turns(angle: float, axis: list[float]) -> None:
    vector = angle * np.array(axis)
    rotation = poses.so3_exp(vector)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    back = poses.so3_log(rotation)
    assert np.linalg.norm(back) == pytest.approx(angle, abs=1e-8)
    np.testing.assert_allclose(poses.so3_exp(back), rotation, atol=1e-8)  # at a half turn the axis may point either way
    if angle < 1e-2:
        np.testing.assert_allclose(back, vector, rtol=1e-6, atol=1e-18)


def test_many_exponentials_at_once() -> None:
    vectors_ = np.random.default_rng(1).normal(size=(4, 5, 3))
    vectors_[0, 0] = 0
    rotations_ = poses.so3_exp(vectors_)
    assert rotations_.shape == (4, 5, 3, 3)
    np.testing.assert_allclose(rotations_[2, 3], poses.so3_exp(vectors_[2, 3]))
    np.testing.assert_array_equal(rotations_[0, 0], np.eye(3))


@settings(deadline=None)
@given(seeds)
def test_quaternions_are_scipys_and_pytransform3ds(seed: int) -> None:
    rotation = Rotation.random(random_state=seed % 2**31)
    quaternion = poses.quaternion_from_rotation(rotation.as_matrix())
    assert quaternion[3] >= 0
    expected = rotation.as_quat()
    np.testing.assert_allclose(quaternion, expected if expected[3] >= 0 else -expected, atol=1e-12)
    np.testing.assert_allclose(poses.rotation_from_quaternion(-3.7 * quaternion), rotation.as_matrix(), atol=1e-12)
    w, x, y, z = rotations.quaternion_from_matrix(rotation.as_matrix())
    assert abs(float(np.dot(quaternion, [x, y, z, w]))) == pytest.approx(1.0)


@settings(deadline=None)
@given(seeds, seeds)
def test_transforms_are_pytransform3ds(seed: int, other: int) -> None:
    a_from_b, b_from_c = random_pose(seed), random_pose(other)
    np.testing.assert_allclose(poses.inverse(a_from_b), transformations.invert_transform(a_from_b), atol=1e-12)
    np.testing.assert_allclose(a_from_b @ b_from_c, transformations.concat(b_from_c, a_from_b), atol=1e-12)
    points = np.random.default_rng(seed).normal(size=(5, 3))
    homogeneous = transformations.vectors_to_points(points)
    np.testing.assert_allclose(poses.apply(a_from_b, points), transformations.transform(a_from_b, homogeneous)[:, :3], atol=1e-12)
    np.testing.assert_allclose(poses.apply(poses.inverse(a_from_b), poses.apply(a_from_b, points)), points, atol=1e-12)


@settings(deadline=None)
@given(seeds, seeds)
def test_interpolation_meets_its_ends_and_turns_evenly(seed: int, other: int) -> None:
    first, second = random_pose(seed), random_pose(other)
    np.testing.assert_allclose(poses.interpolate(first, second, 0.0), first, atol=1e-12)
    np.testing.assert_allclose(poses.interpolate(first, second, 1.0), second, atol=1e-8)
    third = poses.interpolate(first, second, 1 / 3)
    whole = poses.rotation_angle(first[:3, :3].T @ second[:3, :3])
    assert poses.rotation_angle(first[:3, :3].T @ third[:3, :3]) == pytest.approx(whole / 3, abs=1e-8)
    np.testing.assert_allclose(third[:3, 3], (2 * first[:3, 3] + second[:3, 3]) / 3, atol=1e-12)


def test_extrapolation_goes_on_at_the_same_speed() -> None:
    turn = poses.transform(poses.so3_exp([0, 0, 0.1]), [1.0, 0, 0])
    double = poses.interpolate(np.eye(4), turn, 2.0)
    np.testing.assert_allclose(double, poses.transform(poses.so3_exp([0, 0, 0.2]), [2.0, 0, 0]), atol=1e-12)


def test_skew_is_the_cross_product() -> None:
    a, b = np.array([1.0, -2.0, 3.0]), np.array([0.5, 4.0, -1.0])
    np.testing.assert_allclose(poses.skew(a) @ b, np.cross(a, b))


def test_nearest_rotation_of_a_disturbed_one_and_of_a_mirror() -> None:
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    np.testing.assert_allclose(poses.nearest_rotation(2.5 * rotation), rotation, atol=1e-12)
    assert np.linalg.det(poses.nearest_rotation(np.diag([1.0, 1.0, -1.0]) @ rotation)) == pytest.approx(1.0)


def test_adjoint_carries_small_motions():
    a_from_b = poses.transform(poses.so3_exp([0.3, -0.5, 0.9]), [1.0, -2.0, 0.5])
    small = 1e-6 * np.array([1.0, -2, 3, 0.5, -1, 2])

    def move(twist):
        return poses.transform(poses.so3_exp(twist[:3]), twist[3:])

    np.testing.assert_allclose(a_from_b @ move(small), move(poses.adjoint(a_from_b) @ small) @ a_from_b, atol=1e-10)


@pytest.mark.parametrize(
    ("rotation", "swing_deg", "twist_deg"),
    [
        (np.eye(3), 0, 0),
        ([[0, -1, 0], [1, 0, 0], [0, 0, 1]], 0, 90),  # x to y
        ([[-1, 0, 0], [0, -1, 0], [0, 0, 1]], 0, 180),
        ([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], 0, -90),
        ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], 90, 0),  # about x: z goes to -y
        ([[0, 0, 1], [1, 0, 0], [0, 1, 0]], 90, 90),  # about z by 90 degrees, then about x by 90
        ([[-1, 0, 0], [0, 1, 0], [0, 0, -1]], 180, 0),  # about y
    ],
)
def test_a_rotation_is_a_twist_about_z_and_then_a_swing(rotation: list[list[int]], swing_deg: float, twist_deg: float) -> None:
    swing, twist = np.degrees(poses.swing_and_twist(rotation))
    assert swing == pytest.approx(swing_deg, abs=1e-6)
    assert (twist - twist_deg + 180) % 360 - 180 == pytest.approx(0, abs=1e-6)


@given(st.floats(-3.1, 3.1), st.floats(0, 3.0), st.floats(-3.1, 3.1))
def test_swing_and_twist_put_together_are_the_rotation(twist: float, swing: float, direction: float) -> None:
    rotation = poses.so3_exp([swing * np.cos(direction), swing * np.sin(direction), 0]) @ poses.so3_exp([0, 0, twist])
    np.testing.assert_allclose(poses.swing_and_twist(rotation), (swing, twist), atol=1e-6)
