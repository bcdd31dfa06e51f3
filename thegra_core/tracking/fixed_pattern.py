"""Keypoints on what belongs to the camera and not to the scene: the sensor's fixed pattern, an overlay, a part of the vehicle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from thegra_core.messages import Features, Matches

BoolArray = NDArray[np.bool_]
FloatArray = NDArray[np.float32]

NEIGHBOURS = 8
STILL_PX = 1.0
"""Displacement of a keypoint that stays where it is."""
MOVING_PX = 4.0
"""Displacement of those around it from which they move."""
MOST_STILL = 0.3
"""Share of all matches that stand still from which the camera does."""
AGREEMENT = 2.0
"""Displacement around a keypoint over the spread of those it is the median of, from which they agree."""
SIGHTINGS = 3
"""Times more often still than moving that make a place one of the camera's."""
MOST = 100
"""Sightings that are counted: a place that has changed can be unlearnt in as many frames."""


class FixedPatternMask:
    """Learns from matches where keypoints do not take part in the motion of the image around them, and keeps keypoints off those places.

    The motion around a keypoint is the median displacement of the nearest matches that move, if these agree on one: about the point that the camera
    moves towards, where all stands still and nothing is wrong, they go apart. Where much stands still it is the camera that does.
    """

    def __init__(self) -> None:
        self._counts: NDArray[np.int16] | None = None

    def apply(self, features: Features) -> Features:
        """The features without keypoints at known places."""
        if self._counts is None or self._counts.shape != features.image_size[::-1]:
            return features
        x, y = _pixels(features)
        keep = self._counts[y, x] < SIGHTINGS
        return features if keep.all() else _select(features, keep)

    def learn(self, features: Features, reference: Features, matches: Matches) -> Matches:
        """Take the matches of a frame; returns them without those that stand still in what moves."""
        if len(matches) <= NEIGHBOURS:
            return matches
        here, there = features.keypoints[matches.indices[:, 0]], reference.keypoints[matches.indices[:, 1]]
        still, moving = still_in_motion(here, there)
        if not still.any() and self._counts is None:
            return matches
        if self._counts is None or self._counts.shape != features.image_size[::-1]:
            self._counts = np.zeros(features.image_size[::-1], np.int16)
        x, y = (coordinate[matches.indices[:, 0]] for coordinate in _pixels(features))
        height, width = self._counts.shape
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                near_y, near_x = np.clip(y[still] + dy, 0, height - 1), np.clip(x[still] + dx, 0, width - 1)
                self._counts[near_y, near_x] += 1
        self._counts[y[moving], x[moving]] -= 1
        np.clip(self._counts, 0, MOST, out=self._counts)
        return matches if not still.any() else replace(matches, indices=matches.indices[~still], confidence=matches.confidence[~still])

    def forget(self) -> None:
        """Begin anew: the shutter has set another pattern."""
        self._counts = None


def still_in_motion(here: FloatArray, there: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Of keypoints `here` (M, 2) px matched to `there` (M, 2) px, M > 8: which stay on their pixel while those around them move, and which move."""
    displacement = here - there
    own = np.linalg.norm(displacement, axis=1)
    still, moving = own < STILL_PX, own > MOVING_PX
    if still.mean() > MOST_STILL or moving.sum() < NEIGHBOURS:
        return np.zeros_like(still), np.zeros_like(moving)
    _, near = cKDTree(here[moving]).query(here[still], NEIGHBOURS)
    flows = displacement[moving][near]
    middle = np.median(flows, axis=1, keepdims=True)
    apart = np.median(np.linalg.norm(flows - middle, axis=2), axis=1)
    around = np.linalg.norm(middle[:, 0], axis=1)
    still[still] = (around > MOVING_PX) & (around > AGREEMENT * apart)
    return still, moving


def _pixels(features: Features) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Whole-pixel x and y (N,) of the keypoints, inside the image."""
    width, height = features.image_size
    pixels = np.rint(features.keypoints).astype(np.int64)
    return np.clip(pixels[:, 0], 0, width - 1), np.clip(pixels[:, 1], 0, height - 1)


def _select(features: Features, keep: BoolArray) -> Features:
    return features.chosen(np.flatnonzero(keep))
