"""The two criteria of the paper at both sides of their limits, and ours."""

from __future__ import annotations

import numpy as np
import pytest

from thegra_core.config import KeyframeConfig
from thegra_core.geometry import poses
from thegra_core.tracking.keyframe_policy import foreseen, needs_keyframe

CONFIG = KeyframeConfig()
LAST = poses.transform(poses.so3_exp([0.4, -1.2, 0.3]), [3.0, -2.0, 7.0])


def asked(motion: np.ndarray, depth: float = 2.0, tracked: float = 1.0, config: KeyframeConfig = CONFIG) -> str:
    return needs_keyframe(LAST, LAST @ motion, depth, tracked, config)


@pytest.mark.parametrize("axis", [[1.0, 0, 0], [0, -1.0, 0], [0.6, 0, 0.8]])
def test_fifteen_degrees(axis: list[float]) -> None:
    turn = np.radians(15.0) * np.array(axis)
    assert asked(poses.transform(poses.so3_exp(0.9999 * turn), [0, 0, 0])) == ""
    assert asked(poses.transform(poses.so3_exp(1.0001 * turn), [0, 0, 0])) == "rotation"


@pytest.mark.parametrize("depth", [0.5, 2.0, 40.0])
def test_three_hundredths_of_the_depth(depth: float) -> None:
    step = 0.03 * depth * np.array([0.48, -0.6, 0.64])
    assert asked(poses.transform(np.eye(3), 0.9999 * step), depth) == ""
    assert asked(poses.transform(np.eye(3), 1.0001 * step), depth) == "translation"


def test_without_a_depth_only_rotation_counts() -> None:
    assert asked(poses.transform(np.eye(3), [5.0, 0, 0]), float("nan")) == ""
    assert asked(poses.transform(poses.so3_exp([0, 0, 0.5]), [5.0, 0, 0]), float("nan")) == "rotation"


def test_few_tracked_landmarks_unless_switched_off() -> None:
    assert asked(np.eye(4), tracked=0.5) == ""
    assert asked(np.eye(4), tracked=0.4999) == "few landmarks tracked"
    assert asked(np.eye(4), tracked=0.0, config=KeyframeConfig(min_tracked_ratio=0.0)) == ""


@pytest.mark.parametrize(("ratios", "next_one"), [((), 1.0), ((0.8,), 0.8), ((0.8, 0.7), 0.6), ((0.6, 0.6), 0.6)])
def test_what_is_seen_of_a_keyframe_goes_on_to_change_alike(ratios: tuple[float, ...], next_one: float) -> None:
    assert foreseen(ratios) == pytest.approx(next_one)
