"""Tracking by followed keypoints: each brings along the landmark that its track sees, so that a pose takes one motion-only bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import ThegraConfig
from thegra_core.features.tracks import followed_rows
from thegra_core.geometry import poses
from thegra_core.map.map import Map
from thegra_core.messages import NO_LANDMARK, Features
from thegra_core.optimization.pose import RANSAC_THRESHOLD_PX, estimate_pose
from thegra_core.tracking.tracker import FrameView, Localization

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
MOST_LOST = 0.5
"""Share of the landmarks that may not fit a pose that was found from the predicted one; beyond it the prediction is not trusted."""
LEAST_RIGHT = 0.25
"""Share of the landmarks that fit the best pose below which the tracks are taken for wrong, and not for few."""


@dataclass(frozen=True, slots=True)
class NotPlaced:
    """Why followed keypoints give no pose; misled: they contradict what the map knows of them."""

    reason: str
    misled: bool = False


class TrackLandmarks:
    """Which landmark each track sees, as far as is known: from frames that were matched with the map, and from what mapping made of them since."""

    def __init__(self) -> None:
        self._ids = self._landmarks = np.empty(0, np.int64)

    def of(self, track_ids: IntArray) -> IntArray:
        """Landmark (N,) of each track (N,), `NO_LANDMARK` where none is known."""
        if len(self._ids) == 0:
            return np.full(len(track_ids), NO_LANDMARK, np.int64)
        rows = np.minimum(np.searchsorted(self._ids, track_ids), len(self._ids) - 1)
        return np.where(self._ids[rows] == track_ids, self._landmarks[rows], NO_LANDMARK)

    def replace(self, features: Features, landmark_ids: IntArray) -> None:
        """Take the landmarks (N,) of a frame's keypoints and forget all other tracks: they have ended."""
        if features.track_ids is None:
            self._ids = self._landmarks = np.empty(0, np.int64)
            return
        rows = followed_rows(features)
        order = rows[np.argsort(features.track_ids[rows])]
        self._ids, self._landmarks = features.track_ids[order], landmark_ids[order]

    def take(self, features: Features, landmark_ids: IntArray) -> None:
        """Take what mapping made of a keyframe's keypoints: for the tracks that go on, or, where none is known, for all."""
        if len(self._ids) == 0:
            self.replace(features, landmark_ids)
        elif features.track_ids is not None:
            rows = followed_rows(features)
            _, here, there = np.intersect1d(self._ids, features.track_ids[rows], assume_unique=True, return_indices=True)
            self._landmarks[here] = landmark_ids[rows[there]]


def localize_followed(
    current: Map, features: Features, landmark_ids: IntArray, predicted_world_from_camera: FloatArray | None, config: ThegraConfig
) -> Localization | NotPlaced:
    """Place a frame by the landmarks (N,) of its followed keypoints, or say why that failed.

    No landmark is looked for beside those followed, so that these alone count as visible.
    """
    settings = config.tracking
    view = FrameView(features, current.camera, config)
    rows = current.landmarks.rows(landmark_ids)
    keypoints = np.flatnonzero((rows >= 0) & view.defined)
    if len(keypoints) < settings.min_inliers:
        return NotPlaced(f"{len(keypoints)} followed landmarks of at least {settings.min_inliers}")
    points = current.landmarks.points_world[rows[keypoints]]
    estimate = None
    if predicted_world_from_camera is not None:
        estimate = view.refine(poses.inverse(predicted_world_from_camera), points, keypoints, settings.chi2_px2)
    if estimate is None or estimate.inliers.sum() < MOST_LOST * len(keypoints):
        pose, count = estimate_pose(points, view.normalized[keypoints], view.focal, RANSAC_THRESHOLD_PX, config.seed)
        if count < settings.min_inliers:
            return NotPlaced(f"{count} inliers of {len(keypoints)} followed landmarks", count < LEAST_RIGHT * len(keypoints))
        estimate = view.refine(pose, points, keypoints, settings.chi2_px2)
    if estimate.inliers.sum() < settings.min_inliers:
        return NotPlaced(f"{int(estimate.inliers.sum())} inliers of {len(keypoints)} followed landmarks")
    found = np.full(len(features), NO_LANDMARK, np.int64)
    found[keypoints[estimate.inliers]] = landmark_ids[keypoints[estimate.inliers]]
    return Localization(estimate.camera_from_world, estimate.covariance, found, np.unique(landmark_ids[keypoints]), len(keypoints))
