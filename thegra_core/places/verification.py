"""Whether two keyframes that look alike see the same place: by matches, a pose, and the scale that both give it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import LoopConfig, MatcherConfig, ThegraConfig, TrackingConfig
from thegra_core.features.nearest import Nearest
from thegra_core.features.protocols import Matcher
from thegra_core.geometry import poses
from thegra_core.geometry.similarity import Similarity
from thegra_core.map.inheritance import inherited_landmarks
from thegra_core.map.map import Map, MapKeyframe
from thegra_core.map.projection import visible_landmarks
from thegra_core.messages import Matches
from thegra_core.optimization.pose import RANSAC_THRESHOLD_PX, estimate_pose, refine_pose
from thegra_core.optimization.weighting import observation_weights

IntArray = NDArray[np.int64]
LESS_ALONE = 2.0
"""Times fewer inliers than are asked for with which the candidate alone must place a keyframe, before its neighbours are matched, too. Where 40 are asked for,
places seen again have 34 to 117 by the candidate alone, what looks alike mostly 5 to 28 (measured)."""
_NEAREST = Nearest(MatcherConfig(ratio=0.9))


@dataclass(frozen=True, slots=True)
class Sighting:
    """A keyframe placed by an old part of its map: where it should be, (old units per new unit as scale), and by what.

    keypoints (M,) of the keyframe see landmarks (M,) of the old place, of `visible` that should be seen from there; matches maps the old keyframes to the
    matches with them.
    """

    keyframe_id: int
    world_from_camera: Similarity
    keypoints: IntArray
    landmarks: IntArray
    matches: Mapping[int, Matches]
    visible: int


@dataclass(frozen=True, slots=True)
class Drift:
    """What a loop says has gone wrong on the way since the old place: degrees, distance over the length of the way, and the logarithm of the scale."""

    turned_deg: float
    moved_ratio: float
    log_scale: float

    def is_possible(self, config: LoopConfig) -> bool:
        """Whether so much may drift. A drift of scale by itself moves what lies behind the camera, by half the way for each factor of e."""
        return self.turned_deg <= config.max_drift_deg and self.moved_ratio <= config.max_drift_ratio + 0.5 * abs(self.log_scale)

    def __str__(self) -> str:
        return f"turn it by {self.turned_deg:.0f} degrees and move it by {self.moved_ratio:.2f} of the way since"


def sight(new: Map, keyframe_id: int, old: Map, group: list[int], matcher: Matcher, config: ThegraConfig) -> Sighting | str:
    """Place a keyframe of `new` by the landmarks of `group`, keyframes of `old`, the candidate first; a string says why that failed.

    Both are the same map for a loop, and two maps where they may be one world.
    """
    settings = config.loop
    keyframe = new.keyframes[keyframe_id]
    candidate = old.keyframes[group[0]].features
    if settings.min_nearest:
        cheap = _placed(keyframe, old, {group[0]: _NEAREST.match(keyframe.features, candidate)}, settings.min_nearest, config)
        if isinstance(cheap, str):
            return f"{cheap} of the candidate by nearest descriptors"
    first = matcher.match(keyframe.features, candidate)
    if len(first) < settings.min_matches:
        return f"{len(first)} matches"
    alone = _placed(keyframe, old, {group[0]: first}, settings.min_inliers / LESS_ALONE, config)
    if isinstance(alone, str):
        return f"{alone} of the candidate"
    others = matcher.match_many(keyframe.features, [old.keyframes[i].features for i in group[1:]])
    matched = dict(zip(group, [first, *others], strict=True))
    placed = _placed(keyframe, old, matched, settings.min_inliers, config)
    if isinstance(placed, str):
        return placed
    start, keypoints, landmarks = placed
    points, focal = old.landmarks.points_world[old.landmarks.rows(landmarks)], old.camera.focal
    weights = observation_weights(keyframe.features.scores, config.weighting)[keypoints]
    estimate = refine_pose(start, points, keyframe.normalized[keypoints], focal, weights, config.tracking.chi2_px2)
    keypoints, landmarks, points = keypoints[estimate.inliers], landmarks[estimate.inliers], points[estimate.inliers]
    if len(keypoints) < settings.min_inliers:
        return f"{len(keypoints)} landmarks agree with one pose"
    visible = len(should_be_seen(old, list(matched), estimate.camera_from_world, config.tracking))
    if len(keypoints) < settings.min_visible_share * visible:
        return f"{len(keypoints)} landmarks agree with one pose, {visible} should be seen from there"
    scale = _scale(new, keyframe, keypoints, poses.apply(estimate.camera_from_world, points)[:, 2], config)
    if isinstance(scale, str):
        return scale
    return Sighting(keyframe_id, Similarity(poses.inverse(estimate.camera_from_world), scale), keypoints, landmarks, matched, visible)


def drift_of(current: Map, sighting: Sighting) -> Drift:
    """By how much a sighting of the same map corrects its keyframe.

    Buildings repeat themselves: what looks alike at another place asks for a correction as large as the way between the two.
    """
    estimated = Similarity(current.keyframes[sighting.keyframe_id].world_from_camera)
    correction = sighting.world_from_camera @ estimated.inverse()
    old = next(iter(sighting.matches))
    first, last = sorted((old, sighting.keyframe_id))
    centers = np.array([current.keyframes[i].center for i in sorted(current.keyframes) if first <= i <= last])
    way = float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum())
    moved = float(np.linalg.norm(sighting.world_from_camera.rigid[:3, 3] - estimated.rigid[:3, 3]))
    return Drift(float(np.degrees(poses.rotation_angle(correction.rigid[:3, :3]))), moved / max(way, 1e-9), float(np.log(correction.scale)))


def agree(new: Map, one: Sighting, other: Sighting, config: ThegraConfig) -> bool:
    """Whether two keyframes of the new map or part are moved alike by their sightings of the old one."""
    settings = config.loop
    correction = one.world_from_camera @ Similarity(new.keyframes[one.keyframe_id].world_from_camera).inverse()
    expected = correction @ Similarity(new.keyframes[other.keyframe_id].world_from_camera)
    difference = expected.inverse() @ other.world_from_camera
    depth = new.median_depth(other.keyframe_id)
    return bool(
        np.degrees(poses.rotation_angle(difference.rigid[:3, :3])) <= settings.max_rotation_deg
        and float(np.linalg.norm(difference.rigid[:3, 3])) <= settings.max_translation_ratio * depth
        and abs(np.log(difference.scale)) <= settings.max_scale_spread
    )


def should_be_seen(place: Map, group: list[int], camera_from_world: NDArray[np.float64], config: TrackingConfig) -> IntArray:
    """Ids (V,) of the landmarks that keyframes `group` of a place see and a camera there should see, too."""
    ids = np.unique(np.concatenate([place.keyframes[i].landmark_ids for i in group]))
    alive = ids[place.landmarks.rows(ids) >= 0]
    return visible_landmarks(place.landmarks, alive, camera_from_world, place.camera, config).ids


def _placed(
    keyframe: MapKeyframe, old: Map, matched: Mapping[int, Matches], enough: float, config: ThegraConfig
) -> tuple[NDArray[np.float64], IntArray, IntArray] | str:
    """A first camera_from_world (4, 4) that enough landmarks agree with, of those (M,) that keypoints (M,) inherit; a string says that too few do."""
    keypoints, landmarks = inherited_landmarks(old, matched, np.asarray(np.isfinite(keyframe.normalized).all(axis=1)))
    if len(keypoints) < enough:
        return f"{len(keypoints)} matches with landmarks"
    points = old.landmarks.points_world[old.landmarks.rows(landmarks)]
    start, found = estimate_pose(points, keyframe.normalized[keypoints], old.camera.focal, RANSAC_THRESHOLD_PX, config.seed)
    return (start, keypoints, landmarks) if found >= enough else f"{found} inliers of {len(keypoints)} matches with landmarks"


def _scale(new: Map, keyframe: MapKeyframe, keypoints: IntArray, old_depth: NDArray[np.float64], config: ThegraConfig) -> float | str:
    """Old over new depth of the keypoints that have a landmark in both parts."""
    rows = new.landmarks.rows(keyframe.landmark_ids[keypoints])
    new_depth = poses.apply(keyframe.camera_from_world, new.landmarks.points_world[np.maximum(rows, 0)])[:, 2]
    use = (rows >= 0) & (new_depth > 0) & (old_depth > 0)
    if use.sum() < config.loop.min_scale_pairs:
        return f"{int(use.sum())} landmarks of both places"
    ratio = np.log(old_depth[use] / new_depth[use])
    middle = float(np.median(ratio))
    spread = float(np.median(np.abs(ratio - middle)))
    return float(np.exp(middle)) if spread <= config.loop.max_scale_spread else f"scales differ by {100 * spread:.0f} %"
