"""Which way round images lie, for cameras turned by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import CAMERA, look, no_features

from thegra_core.map.map import Map, MapKeyframe
from thegra_core.map.orientation import apparent_roll_deg, lie_alike, wanted_turns


def keyframe(pose: np.ndarray, turns: int = 0, number: int = 0) -> MapKeyframe:
    features = replace(no_features(number), turns=turns)
    return MapKeyframe(number, number, pose, features, np.empty((0, 2)), np.empty(0, np.int64), number)


def map_of(*keyframes: MapKeyframe) -> Map:
    current = Map(0, CAMERA)
    current.keyframes.update({k.id: k for k in keyframes})
    return current


UPRIGHT = look((0, 0, 0))


@pytest.mark.parametrize(
    ("roll_deg", "turns", "first_turns", "lies"),
    [
        (0, 0, 0, 0),
        (30, 0, 0, 30),  # the camera rolls clockwise: what it shows turns counter-clockwise
        (90, 3, 0, 0),  # and has to be turned clockwise, which is three quarter turns counter-clockwise
        (90, 1, 0, -180),
        (-90, 1, 0, 0),
        (180, 2, 0, 0),
        (200, 2, 0, 20),
        (0, 1, 1, 0),  # the map began with turned images
        (90, 0, 1, 0),
        (0, 0, 1, -90),
    ],
)
def test_how_an_image_lies(roll_deg: float, turns: int, first_turns: int, lies: float) -> None:
    lying = apparent_roll_deg(keyframe(UPRIGHT, first_turns), look((3, 2, 1), roll_deg=roll_deg), turns)
    assert lying is not None
    assert (lying - lies + 180) % 360 - 180 == pytest.approx(0, abs=1e-6) and -180 <= lying < 180


def test_it_is_told_of_the_pose_of_the_first_keyframe_wherever_that_lies_in_the_world() -> None:
    world = look((1, 2, 3), 40, -80, 170)
    assert apparent_roll_deg(keyframe(world @ UPRIGHT), world @ look((0, 1, 0), roll_deg=50), 0) == pytest.approx(50)


@pytest.mark.parametrize(("yaw_deg", "told"), [(50, True), (-50, True), (70, False), (180, False)])
def test_cameras_that_look_elsewhere_are_not_compared(yaw_deg: float, told: bool) -> None:
    """A camera that looks around, level all the while, has not rolled."""
    lying = apparent_roll_deg(keyframe(UPRIGHT), look((0, 0, 0), yaw_deg=yaw_deg), 0)
    assert lying == pytest.approx(0, abs=1e-6) if told else lying is None
    assert wanted_turns(map_of(keyframe(UPRIGHT)), look((0, 0, 0), yaw_deg=yaw_deg, roll_deg=100), 0) == (3 if told else 0)
    assert lie_alike(keyframe(UPRIGHT), look((0, 0, 0), yaw_deg=yaw_deg, roll_deg=100), 3)


@pytest.mark.parametrize(
    ("roll_deg", "turns", "wanted"),
    [(54, 0, 0), (56, 0, 3), (-56, 0, 1), (90, 0, 3), (36, 3, 3), (34, 3, 0), (144, 3, 3), (146, 3, 2), (180, 0, 2), (136, 0, 2), (134, 0, 3), (-90, 2, 1), (359, 0, 0)],
)
def test_turns_change_where_the_camera_has_rolled_well_beyond_half_a_quarter(roll_deg: float, turns: int, wanted: int) -> None:
    """Turned by three quarters, images lie right at a roll of 90 degrees, and well enough from 35 to 145."""
    current = map_of(keyframe(look((0, 0, 0), roll_deg=120), turns=0, number=7), keyframe(UPRIGHT, number=2))
    assert wanted_turns(current, look((5, 0, 0), roll_deg=roll_deg), turns) == wanted


def test_what_lies_alike() -> None:
    pose = look((0, 0, 0), roll_deg=90)
    assert lie_alike(keyframe(UPRIGHT), pose, 3)
    assert not lie_alike(keyframe(UPRIGHT), pose, 2)
    assert lie_alike(keyframe(look((0, 0, 0), roll_deg=36)), pose, 3) and not lie_alike(keyframe(look((0, 0, 0), roll_deg=34)), look((0, 0, 0), roll_deg=180), 3)
    assert lie_alike(keyframe(UPRIGHT), pose, 0), "nothing was turned: as without turning at all"
