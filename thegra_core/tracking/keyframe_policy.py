"""When a tracked frame becomes a keyframe (paper Sec. III-C)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import KeyframeConfig
from thegra_core.geometry import poses

FloatArray = NDArray[np.float64]


def needs_keyframe(
    last_world_from_camera: FloatArray, world_from_camera: FloatArray, median_depth: float, tracked_ratio: float, config: KeyframeConfig
) -> str:
    """Why a keyframe is due, or an empty string.

    The paper's two criteria: rotation since the last keyframe, and displacement over the median scene depth. Beyond the paper, too small a share
    of the reference keyframe's landmarks still tracked.
    """
    relative = poses.inverse(last_world_from_camera) @ world_from_camera
    if poses.rotation_angle(relative[:3, :3]) > np.radians(config.rotation_deg):
        return "rotation"
    if np.isfinite(median_depth) and np.linalg.norm(relative[:3, 3]) > config.translation_ratio * median_depth:
        return "translation"
    if tracked_ratio < config.min_tracked_ratio:
        return "few landmarks tracked"
    return ""
