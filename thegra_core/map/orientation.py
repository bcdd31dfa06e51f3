"""Which way round images lie: how what one shows is turned against what another one shows, each as it was turned before features were looked for in it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry import poses
from thegra_core.map.map import Map, MapKeyframe

FloatArray = NDArray[np.float64]
MAX_SWING_DEG = 60.0
"""Between two optical axes; beyond it the images have no direction in common that could be up in both."""
HYSTERESIS_DEG = 10.0
"""Beyond half a quarter turn, so that a camera that is held there does not turn its images to and fro."""


def apparent_roll_deg(keyframe: MapKeyframe, world_from_camera: FloatArray, turns: int) -> float | None:
    """Degrees in [-180, 180) by which an image that was turned by `turns` shows things turned counter-clockwise against a keyframe's image as that was turned.

    A camera that rolls clockwise, as it looks, shows things turned counter-clockwise. None if the two look in too different directions to compare them.
    """
    swing, twist = poses.swing_and_twist(keyframe.world_from_camera[:3, :3].T @ world_from_camera[:3, :3])
    if np.degrees(swing) > MAX_SWING_DEG:
        return None
    return float((np.degrees(twist) + 90 * (turns - keyframe.features.turns) + 180) % 360 - 180)


def wanted_turns(current: Map, world_from_camera: FloatArray, turns: int) -> int:
    """By how many quarter turns (0 to 3) an image had better be turned to lie as the map's first one does; `turns` where that is good enough."""
    roll = apparent_roll_deg(current.keyframes[min(current.keyframes)], world_from_camera, turns)
    if roll is None or abs(roll) <= 45 + HYSTERESIS_DEG:
        return turns
    return (turns - round(roll / 90)) % 4


def lie_alike(keyframe: MapKeyframe, world_from_camera: FloatArray, turns: int) -> bool:
    """Whether a keyframe's features can be expected to look like those of an image that was turned by `turns`, as far as turning is concerned."""
    if keyframe.features.turns == turns:
        return True
    roll = apparent_roll_deg(keyframe, world_from_camera, turns)
    return roll is None or abs(roll) <= 45 + HYSTERESIS_DEG
