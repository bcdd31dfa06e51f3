"""From the optical camera frame to the robot's frames."""

from __future__ import annotations

import numpy as np
import pytest

from thegra_core.geometry.poses import inverse, so3_exp, transform
from thegra_ros.transforms import BODY_FROM_OPTICAL, UNKNOWN_VARIANCE, Frames, PoseHistory, chain, extrinsics, map_points, map_pose, stamped_pose

RNG = np.random.default_rng(4)
AHEAD = transform(np.eye(3), [0, 0, 1])  # one unit along the optical axis
RIGHT = transform(np.eye(3), [1, 0, 0])
TILTED = Frames(base="base_link", base_from_camera=transform(so3_exp([0, 0.4, 0]) @ BODY_FROM_OPTICAL[:3, :3], [0.3, 0.0, 0.2]), scale=2.0)
"""A camera 0.3 m ahead of the base and 0.2 m above it, that looks down by 0.4 rad; a map unit is 2 m."""


def random_pose() -> np.ndarray:
    return transform(so3_exp(RNG.normal(0, 0.7, 3)), RNG.normal(0, 3, 3))


@pytest.mark.parametrize("base", ["", "base_link"])
def test_forward_along_the_optical_axis_is_x(base: str) -> None:
    frames = Frames(base=base)
    np.testing.assert_allclose(map_pose(AHEAD, frames)[:3, 3], [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(map_pose(RIGHT, frames)[:3, 3], [0, -1, 0], atol=1e-15)


def test_the_base_starts_at_the_origin_and_level() -> None:
    np.testing.assert_allclose(map_pose(np.eye(4), TILTED), np.eye(4), atol=1e-15)


def test_the_camera_alone_is_published_in_its_optical_frame() -> None:
    np.testing.assert_allclose(map_pose(np.eye(4), Frames()), BODY_FROM_OPTICAL, atol=1e-15)
    looks = map_pose(random_pose(), Frames())[:3, 2]  # its z axis, in the map
    assert np.linalg.norm(looks) == pytest.approx(1.0)


def test_a_base_that_drives_straight_moves_along_x_whatever_the_camera_tilts() -> None:
    """The base moves 1.5 m forward; the camera sees that as a motion in its own, tilted frame, of 0.75 map units."""
    base_moved = transform(np.eye(3), [1.5, 0, 0])
    camera_moved = inverse(TILTED.base_from_camera) @ base_moved @ TILTED.base_from_camera
    camera_moved[:3, 3] /= TILTED.scale
    np.testing.assert_allclose(map_pose(camera_moved, TILTED), base_moved, atol=1e-14)


def test_points_stay_where_the_camera_sees_them() -> None:
    """A point in front of the camera has one place in the map, by the pose and by itself."""
    pose, point_camera = random_pose(), np.array([0.2, -0.4, 3.0])
    point_world = pose[:3, :3] @ point_camera + pose[:3, 3]
    by_map = map_points(point_world[None], TILTED)[0]
    in_base = TILTED.base_from_camera[:3, :3] @ (TILTED.scale * point_camera) + TILTED.base_from_camera[:3, 3]
    map_from_base = map_pose(pose, TILTED)
    np.testing.assert_allclose(by_map, map_from_base[:3, :3] @ in_base + map_from_base[:3, 3], atol=1e-12)


def test_covariance_and_twist_follow_perturbations() -> None:
    """Perturb the camera by a small motion and compare with what the linear maps say of the base: position and rotation about the map's axes."""
    pose, small = random_pose(), 1e-6
    columns = []
    nominal = map_pose(pose, TILTED)
    for axis in range(6):
        xi = np.zeros(6)
        xi[axis] = small
        moved = map_pose(pose @ transform(so3_exp(xi[:3]), xi[3:]), TILTED)
        turn = moved[:3, :3] @ nominal[:3, :3].T
        columns.append(np.concatenate([moved[:3, 3] - nominal[:3, 3], [turn[2, 1], turn[0, 2], turn[1, 0]]]) / small)
    jacobian = np.stack(columns, axis=1)
    root = RNG.normal(0, 1, (6, 6))
    covariance = root @ root.T
    twist = RNG.normal(0, 1, 6)
    said = stamped_pose(0, pose, covariance, twist, TILTED)
    np.testing.assert_allclose(said.covariance, jacobian @ covariance @ jacobian.T, rtol=1e-4, atol=1e-4)
    in_map = jacobian @ twist
    to_map = nominal[:3, :3]
    np.testing.assert_allclose(to_map @ said.twist[:3], in_map[:3], atol=1e-5)
    np.testing.assert_allclose(to_map @ said.twist[3:], in_map[3:], atol=1e-5)


def test_predictions_and_what_is_unknown_weigh_nothing() -> None:
    predicted = stamped_pose(0, random_pose(), 1e-4 * np.eye(6), np.ones(6), TILTED, predicted=True)
    unknown = stamped_pose(0, random_pose(), None, None, TILTED)
    for pose in (predicted, unknown):
        assert (np.diag(pose.covariance) >= UNKNOWN_VARIANCE).all() and (np.diag(pose.twist_covariance) >= UNKNOWN_VARIANCE).all()
    assert np.diag(stamped_pose(0, random_pose(), 1e-4 * np.eye(6), np.ones(6), Frames()).covariance).max() < 1e-3


def test_history_interpolates_and_admits_what_it_does_not_know() -> None:
    history = PoseHistory(span_ns=10)
    assert history.at(0) is None
    for stamp in (100, 102, 104):
        history.add(stamp, transform(so3_exp([0, 0, 0.1 * stamp]), [float(stamp), 0, 0]))
    np.testing.assert_allclose(history.at(103), transform(so3_exp([0, 0, 10.3]), [103, 0, 0]), atol=1e-12)
    np.testing.assert_allclose(history.at(107, slack_ns=3)[:3, 3], [104, 0, 0])
    assert history.at(108, slack_ns=3) is None
    history.add(115, np.eye(4))
    assert history.at(103, slack_ns=1) is None, "older than its span"
    history.add(50, np.eye(4))
    assert history.at(115, slack_ns=1) is None, "time went back: what was before counts no more"


def test_fixed_transforms_are_chained_up_to_the_base() -> None:
    base_from_link, link_from_camera = random_pose(), random_pose()
    tree = {"camera_link": ("base_link", base_from_link), "camera_optical": ("camera_link", link_from_camera)}
    np.testing.assert_allclose(chain(tree, "base_link", "camera_optical"), base_from_link @ link_from_camera)
    assert chain(tree, "base_link", "other") is None
    assert chain({"a": ("b", np.eye(4)), "b": ("a", np.eye(4))}, "base_link", "a") is None, "a loop ends"


def test_extrinsics_are_checked() -> None:
    np.testing.assert_allclose(extrinsics("1, 2, 3 0 0 0 2"), transform(np.eye(3), [1, 2, 3]))
    for bad in ("1 2 3", "0 0 0 0 0 0 0", "nan 0 0 0 0 0 1", "a b c d e f g"):
        with pytest.raises(ValueError, match="qw"):
            extrinsics(bad)
