"""A camera that turns round while it is tracked: from when on its images are turned back, so that they go on lying as those of the map do.

A turned image hardly shows the same keypoints as the upright one, so nothing can be carried over from the one to the other. But the camera has just seen what it
sees, before it turned: keyframes that lie as the turned image does are near, and place it as they would any frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import LoopConfig, ThegraConfig
from thegra_core.features.protocols import Matcher
from thegra_core.geometry import poses
from thegra_core.map.map import Map
from thegra_core.map.orientation import lie_alike, wanted_turns
from thegra_core.messages import NO_LANDMARK, Features, Matches
from thegra_core.tracking.relocalizer import relocalize
from thegra_core.tracking.tracker import Localization

FloatArray = NDArray[np.float64]
Turned = Callable[[int], Features]
"""The features of the frame being tracked, found in its image turned counter-clockwise by so many quarter turns."""


@dataclass(frozen=True, slots=True)
class FoundTurned:
    """A frame placed by the features of its image turned otherwise, the keyframe that shares most with it, and the matches to that."""

    features: Features
    localization: Localization
    reference_id: int
    matches: Matches


def turn_back(
    current: Map, reference_id: int, found: Localization, turns: int, turned: Turned, matcher: Matcher, config: ThegraConfig
) -> FoundTurned | None:
    """Place a tracked frame, whose image was turned by `turns`, once more, with the image turned so that it lies as the map's first one; None where it does already,
    where `loop.rotations` lacks the angle, or where the keyframes around do not confirm the pose `found`."""
    wanted = wanted_turns(current, found.world_from_camera, turns)
    if 90 * ((wanted - turns) % 4) not in config.loop.rotations:
        return None
    candidates = lying_alike(current, reference_id, found, wanted, config)
    if not candidates:
        return None
    features = turned(wanted)
    again = relocalize(current, features, candidates, matcher, config, nearby=True)
    if again is None or not _agree(found, again[0], current.median_depth(reference_id, found.world_from_camera), config.loop):
        return None
    return FoundTurned(features, *again)


def lying_alike(current: Map, reference_id: int, found: Localization, turns: int, config: ThegraConfig) -> list[int]:
    """At most `relocalization.keyframes` ids around the reference: keyframes that a frame lies as if it is turned, those that share most of its landmarks first."""
    around = (current.keyframes[i] for i in current.local_keyframes(reference_id, config.tracking.local_keyframes))
    ids = found.landmark_ids[found.landmark_ids != NO_LANDMARK]
    shared = {k.id: int(np.isin(k.landmark_ids, ids).sum()) for k in around if lie_alike(k, found.world_from_camera, turns)}
    return sorted(shared, key=lambda i: (-shared[i], -i))[: config.relocalization.keyframes]


def _agree(one: Localization, other: Localization, depth: float, settings: LoopConfig) -> bool:
    """Whether two poses of a frame are one, as near as two keyframes must agree on a loop."""
    apart = one.camera_from_world @ other.world_from_camera
    turned_deg = np.degrees(poses.rotation_angle(apart[:3, :3]))
    return bool(np.linalg.norm(apart[:3, 3]) <= settings.max_translation_ratio * depth and turned_deg <= settings.max_rotation_deg)
