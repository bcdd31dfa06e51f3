"""Two-stage tracking of a frame in a map (paper Sec. III-C, Tracking)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import ThegraConfig, TrackingConfig
from thegra_core.geometry import poses
from thegra_core.geometry.camera import CameraModel
from thegra_core.map.inheritance import inherited_landmarks
from thegra_core.map.map import Map
from thegra_core.map.projection import VisibleLandmarks, match_by_projection, visible_landmarks
from thegra_core.messages import NO_LANDMARK, Features, Matches
from thegra_core.optimization.hybrid import LandmarkView, SharedView, estimate_hybrid_pose, refine_hybrid_pose
from thegra_core.optimization.pose import RANSAC_THRESHOLD_PX, PoseEstimate, estimate_pose, refine_pose
from thegra_core.optimization.weighting import observation_weights

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


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
    """A frame's features with what each step needs of them: undistorted coordinates (N, 2) and weights (N,)."""

    def __init__(self, features: Features, camera: CameraModel, config: ThegraConfig) -> None:
        self.features = features
        self.normalized = camera.undistort(features.keypoints.astype(np.float64))
        self.defined = np.asarray(np.isfinite(self.normalized).all(axis=1))
        self.weights = observation_weights(features.scores, config.weighting)
        self.focal = camera.focal

    def refine(self, camera_from_world: FloatArray, points_world: FloatArray, keypoints: IntArray, chi2_px2: float) -> PoseEstimate:
        """Motion-only bundle adjustment on points (M, 3) seen by keypoints (M,)."""
        return refine_pose(
            camera_from_world, points_world, self.normalized[keypoints], self.focal, self.weights[keypoints], chi2_px2
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

    Stage 1: learned matches `matched` to keyframes, while tracking to the reference keyframe alone, inherit the keyframes' landmarks and give a pose
    by RANSAC and motion-only bundle adjustment; where they are too few the constant-velocity prediction takes its place. Stage 2: the local map's
    visible landmarks are projected and looked for by descriptor, and a second motion-only bundle adjustment uses both. Where that finds too few
    landmarks, the matches that have none take part, too (`localize_sparsely`).
    """
    settings = config.tracking
    view = FrameView(features, current.camera, config)
    landmark_ids = np.full(len(features), NO_LANDMARK, dtype=np.int64)
    first, reason = _pose_from_matches(current, view, matched, landmark_ids, config)
    if first is None and predicted_world_from_camera is None:
        return localize_sparsely(current, view, reference_id, matched, config) or reason
    start = first if first is not None else poses.inverse(predicted_world_from_camera)  # type: ignore[arg-type]
    radius = settings.search_radius_px if first is not None else settings.wide_search_radius_px
    visible = _local_landmarks(current, reference_id, start, settings)
    estimate = _refine_with_local_map(current, view, visible, start, landmark_ids, radius, config)
    inliers = int((landmark_ids != NO_LANDMARK).sum())
    if estimate is None or inliers < settings.min_inliers:
        failure = f"{inliers} of at least {settings.min_inliers} landmarks found" + (f" ({reason})" if reason else "")
        return localize_sparsely(current, view, reference_id, matched, config) or failure
    return _localization(estimate.camera_from_world, estimate.covariance, landmark_ids, visible, matched)


def localize_sparsely(current: Map, view: FrameView, reference_id: int, matched: Mapping[int, Matches], config: ThegraConfig) -> Localization | None:
    """Place a frame by few landmarks and the many matches to keyframes that have none: a view that has turned to where the map holds little."""
    settings = config.tracking
    keypoints, ids = inherited_landmarks(current, matched, view.defined)
    if len(ids) < settings.min_sparse_landmarks:
        return None
    shared, count = _matches_without_landmarks(current, view, matched, keypoints)
    if count < settings.min_sparse_matches:
        return None
    start = estimate_hybrid_pose(_landmark_view(current, view, keypoints, ids), shared, view.focal, RANSAC_THRESHOLD_PX, config.seed)
    if start is None:
        return None
    landmark_ids = np.full(len(view.features), NO_LANDMARK, dtype=np.int64)
    landmark_ids[keypoints] = ids
    visible = _local_landmarks(current, reference_id, start, settings)
    _add_projected(view, visible, landmark_ids, settings.search_radius_px, settings)
    seen = np.flatnonzero(landmark_ids != NO_LANDMARK)
    estimate = refine_hybrid_pose(start, _landmark_view(current, view, seen, landmark_ids[seen]), shared, view.focal, settings.chi2_px2)
    landmark_ids[seen[~estimate.inliers]] = NO_LANDMARK
    agreeing = estimate.agreeing_matches
    if estimate.inliers.sum() < settings.min_sparse_landmarks or agreeing < max(settings.min_sparse_matches, count / 2):
        return None
    return _localization(estimate.camera_from_world, estimate.covariance, landmark_ids, visible, matched)


def _localization(
    camera_from_world: FloatArray, covariance: FloatArray, landmark_ids: IntArray, visible: VisibleLandmarks, matched: Mapping[int, Matches]
) -> Localization:
    seen = np.union1d(visible.ids, landmark_ids[landmark_ids != NO_LANDMARK])
    return Localization(camera_from_world, covariance, landmark_ids, seen, sum(map(len, matched.values())))


def _local_landmarks(current: Map, reference_id: int, camera_from_world: FloatArray, settings: TrackingConfig) -> VisibleLandmarks:
    local = current.landmark_ids_of(current.local_keyframes(reference_id, settings.local_keyframes))
    return visible_landmarks(current.landmarks, local, camera_from_world, current.camera, settings)


def _landmark_view(current: Map, view: FrameView, keypoints: IntArray, ids: IntArray) -> LandmarkView:
    points = current.landmarks.points_world[current.landmarks.rows(ids)]
    return LandmarkView(points, view.normalized[keypoints], view.weights[keypoints])


def _matches_without_landmarks(current: Map, view: FrameView, matched: Mapping[int, Matches], with_landmark: IntArray) -> tuple[list[SharedView], int]:
    """The matches of keypoints that inherit no landmark, by keyframe, and how many there are."""
    shared, count = [], 0
    usable = view.defined.copy()
    usable[with_landmark] = False
    for keyframe_id, matches in matched.items():
        keyframe = current.keyframes[keyframe_id]
        there = keyframe.normalized[matches.indices[:, 1]]
        use = usable[matches.indices[:, 0]] & np.isfinite(there).all(axis=1)
        here = matches.indices[use, 0]
        shared.append(SharedView(keyframe.camera_from_world, there[use], view.normalized[here], view.weights[here]))
        count += int(use.sum())
    return shared, count


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


def _refine_with_local_map(
    current: Map, view: FrameView, visible: VisibleLandmarks, camera_from_world: FloatArray, landmark_ids: IntArray, radius_px: float, config: ThegraConfig
) -> PoseEstimate | None:
    """Stage 2; replaces `landmark_ids` by the inliers of both stages."""
    settings = config.tracking
    _add_projected(view, visible, landmark_ids, radius_px, settings)
    seen = np.flatnonzero(landmark_ids != NO_LANDMARK)
    if len(seen) < 4:
        landmark_ids[:] = NO_LANDMARK
        return None
    points = current.landmarks.points_world[current.landmarks.rows(landmark_ids[seen])]
    estimate = view.refine(camera_from_world, points, seen, settings.chi2_px2)
    landmark_ids[seen[~estimate.inliers]] = NO_LANDMARK
    return estimate


def _add_projected(view: FrameView, visible: VisibleLandmarks, landmark_ids: IntArray, radius_px: float, settings: TrackingConfig) -> None:
    """Give free keypoints the visible landmarks that project near them and look alike."""
    new = ~np.isin(visible.ids, landmark_ids)
    wanted = VisibleLandmarks(visible.ids[new], visible.pixels[new], visible.descriptors[new])
    free = (landmark_ids == NO_LANDMARK) & view.defined
    found, keypoints = match_by_projection(
        wanted, view.features.keypoints, view.features.descriptors, free, radius_px, settings.min_descriptor_similarity, settings.descriptor_ratio
    )
    landmark_ids[keypoints] = wanted.ids[found]


def best_reference(current: Map, landmark_ids: IntArray, candidates: list[int]) -> int:
    """The candidate keyframe that shares most landmarks with a frame's `landmark_ids`, the newest of equals."""
    ids = landmark_ids[landmark_ids != NO_LANDMARK]
    shared = [(int(np.isin(current.keyframes[i].landmark_ids, ids).sum()), i) for i in candidates]
    return max(shared)[1]
