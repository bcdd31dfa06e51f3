"""When a tracked frame becomes a keyframe (paper Sec. III-C)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import KeyframeConfig
from thegra_core.geometry import poses
from thegra_core.messages import Features
from thegra_core.tracking.place import Place

FloatArray = NDArray[np.float64]
ANSWER_NS = 150_000_000
"""Time that mapping may take for a keyframe, with all that it does for it."""


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


def tracked_ratio(place: Place, features: Features, inliers: int) -> float:
    """How much of the last keyframe a frame still sees: landmarks (`inliers`) over those of the reference, or, where a newer keyframe has been made too short a time
    ago for mapping to have told its landmarks, the share of its tracks."""
    newest = place.pending[max(place.pending)].features if place.pending else None
    if newest is not None and newest.track_ids is not None and features.track_ids is not None and features.stamp_ns - newest.stamp_ns < ANSWER_NS:
        tracks = newest.track_ids[newest.track_ids >= 0]
        return float(np.isin(tracks, features.track_ids).sum()) / max(len(tracks), 1)
    reference = place.map.keyframes[place.reference_id]
    return inliers / max(int((place.map.landmarks.rows(reference.landmark_ids) >= 0).sum()), 1)


def foreseen(ratios: Sequence[float]) -> float:
    """What comes next after at most two `tracked_ratio` if they go on to change alike; all of it after none."""
    return 2 * ratios[-1] - ratios[0] if len(ratios) > 1 else ratios[0] if ratios else 1.0
