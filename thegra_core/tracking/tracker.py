"""Two-stage tracking of a frame in a map (paper Sec. III-C, Tracking)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import ThegraConfig
from thegra_core.geometry import poses
from thegra_core.geometry.camera import CameraModel
from thegra_core.map.map import Map
from thegra_core.map.projection import VisibleLandmarks, match_by_projection, visible_landmarks
from thegra_core.messages import NO_LANDMARK, Features, Matches
from thegra_core.optimization.pose import PoseEstimate, estimate_pose, refine_pose
from thegra_core.optimization.weighting import gate_weights, observation_weights

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

RANSAC_THRESHOLD_PX = 4.0
"""Inlier threshold of the first pose: wide, since the map's points carry their own error; refinement gates at the chi-square limit."""


@dataclass(frozen=True, slots=True)
class Localization:
    """A frame placed in a map: pose, covariance (6, 6), the landmark of each keypoint (N,), and the landmarks it should have seen (V,)."""

    camera_from_world: FloatArray
    covariance: FloatArray
    landmark_ids: IntArray
    visible_ids: IntArray
    matches: int

    @property
    def inliers(self) -> int:
        return int((self.landmark_ids != NO_LANDMARK).sum())

    @property
    def world_from_camera(self) -> FloatArray:
        return poses.inverse(self.camera_from_world)


class FrameView:
    """A frame's features with what each step needs of them: undistorted coordinates (N, 2), weights (N,) and gate weights (N,)."""

    def __init__(self, features: Features, camera: CameraModel, config: ThegraConfig) -> None:
        self.features = features
        self.normalized = camera.undistort(features.keypoints.astype(np.float64))
        self.defined = np.asarray(np.isfinite(self.normalized).all(axis=1))
        self.weights = observation_weights(features.scores, config.weighting)
        self.gates = gate_weights(self.weights, config.weighting)
        self.focal = camera.focal

    def refine(self, camera_from_world: FloatArray, points_world: FloatArray, keypoints: IntArray, chi2_px2: float) -> PoseEstimate:
        """Motion-only bundle adjustment on points (M, 3) seen by keypoints (M,)."""
        return refine_pose(
            camera_from_world, points_world, self.normalized[keypoints], self.focal, self.weights[keypoints], self.gates[keypoints], chi2_px2
        )


def localize(
    current: Map,
    features: Features,
    reference_id: int,
    matched: Mapping[int, Matches],
    predicted_world_from_camera: FloatArray | None,
    config: ThegraConfig,
) -> Localization | str:
    """Place a frame in the map; a string says why that failed.

    Stage 1: learned matches `matched` to keyframes, while tracking to the reference keyframe alone, inherit the keyframes' landmarks and give a pose by
    RANSAC and motion-only bundle adjustment; where they are too few the constant-velocity prediction takes its place. Stage 2: the local map's visible landmarks are projected and looked for by
    descriptor, and a second motion-only bundle adjustment uses both.
    """
    settings = config.tracking
    view = FrameView(features, current.camera, config)
    landmark_ids = np.full(len(features), NO_LANDMARK, dtype=np.int64)
    radius = settings.search_radius_px

    matches = sum(map(len, matched.values()))
    first, reason = _pose_from_matches(current, view, matched, landmark_ids, config)
    if first is not None:
        camera_from_world = first
    elif predicted_world_from_camera is not None:
        camera_from_world, radius = poses.inverse(predicted_world_from_camera), settings.wide_search_radius_px
    else:
        return reason

    local = current.landmark_ids_of(current.local_keyframes(reference_id, settings.local_keyframes))
    visible = visible_landmarks(current.landmarks, local, camera_from_world, current.camera, settings)
    estimate = _refine_with_local_map(current, view, visible, camera_from_world, landmark_ids, radius, config)
    inliers = int((landmark_ids != NO_LANDMARK).sum())
    if estimate is None or inliers < settings.min_inliers:
        return f"{inliers} of at least {settings.min_inliers} landmarks found" + (f" ({reason})" if reason else "")
    return Localization(estimate.camera_from_world, estimate.covariance, landmark_ids, np.union1d(visible.ids, landmark_ids[landmark_ids >= 0]), matches)


def _pose_from_matches(
    current: Map, view: FrameView, matched: Mapping[int, Matches], landmark_ids: IntArray, config: ThegraConfig
) -> tuple[FloatArray | None, str]:
    """Stage 1; fills `landmark_ids` with its inliers. Without a pose the second value says why."""
    settings = config.tracking
    keypoints, ids = inherited_landmarks(current, matched, view.defined)
    where = "the reference keyframe" if len(matched) == 1 else f"{len(matched)} keyframes"
    if len(ids) < settings.min_reference_matches:
        return None, f"{sum(map(len, matched.values()))} matches to {where}, {len(ids)} of them with landmarks"
    points = current.landmarks.points_world[current.landmarks.rows(ids)]
    pose, found = estimate_pose(points, view.normalized[keypoints], view.focal, RANSAC_THRESHOLD_PX, config.seed)
    if found < settings.min_reference_inliers:
        return None, f"{found} inliers of {len(ids)} matches to {where}"
    estimate = view.refine(pose, points, keypoints, settings.chi2_px2)
    if estimate.inliers.sum() < settings.min_reference_inliers:
        return None, f"{int(estimate.inliers.sum())} inliers of {len(ids)} matches to {where}"
    landmark_ids[keypoints[estimate.inliers]] = ids[estimate.inliers]
    return estimate.camera_from_world, ""


def inherited_landmarks(current: Map, matched: Mapping[int, Matches], defined: BoolArray) -> tuple[IntArray, IntArray]:
    """Keypoints (M,) of a frame and the landmarks (M,) that they inherit by its matches to keyframes, one to one, the most confident match first.

    defined (N,) bool: the frame's keypoints that may be used.
    """
    keypoints, ids, confidence = [], [], []
    for keyframe_id, matches in matched.items():
        inherited = current.keyframes[keyframe_id].landmark_ids[matches.indices[:, 1]]
        use = (current.landmarks.rows(inherited) >= 0) & defined[matches.indices[:, 0]]
        keypoints.append(matches.indices[use, 0].astype(np.int64))
        ids.append(inherited[use])
        confidence.append(matches.confidence[use])
    all_keypoints, all_ids = np.concatenate(keypoints), np.concatenate(ids)
    order = np.argsort(-np.concatenate(confidence), kind="stable")
    for key in (all_keypoints, all_ids):
        order = order[np.sort(np.unique(key[order], return_index=True)[1])]
    order = order[np.argsort(all_keypoints[order], kind="stable")]
    return all_keypoints[order], all_ids[order]


def _refine_with_local_map(
    current: Map, view: FrameView, visible: VisibleLandmarks, camera_from_world: FloatArray, landmark_ids: IntArray, radius_px: float, config: ThegraConfig
) -> PoseEstimate | None:
    """Stage 2; replaces `landmark_ids` by the inliers of both stages."""
    settings = config.tracking
    new = ~np.isin(visible.ids, landmark_ids)
    wanted = VisibleLandmarks(visible.ids[new], visible.pixels[new], visible.descriptors[new])
    free = (landmark_ids == NO_LANDMARK) & view.defined
    found, keypoints = match_by_projection(
        wanted, view.features.keypoints, view.features.descriptors, free, radius_px, settings.min_descriptor_similarity, settings.descriptor_ratio
    )
    landmark_ids[keypoints] = wanted.ids[found]
    seen = np.flatnonzero(landmark_ids != NO_LANDMARK)
    if len(seen) < 4:
        landmark_ids[:] = NO_LANDMARK
        return None
    points = current.landmarks.points_world[current.landmarks.rows(landmark_ids[seen])]
    estimate = view.refine(camera_from_world, points, seen, settings.chi2_px2)
    landmark_ids[seen[~estimate.inliers]] = NO_LANDMARK
    return estimate


def best_reference(current: Map, landmark_ids: IntArray, candidates: list[int]) -> int:
    """The candidate keyframe that shares most landmarks with a frame's `landmark_ids`, the newest of equals."""
    ids = landmark_ids[landmark_ids != NO_LANDMARK]
    shared = [(int(np.isin(current.keyframes[i].landmark_ids, ids).sum()), i) for i in candidates]
    return max(shared)[1]
