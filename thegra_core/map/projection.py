"""Landmarks projected into an image: the paper's three visibility tests and the search for their keypoints (Sec. III-C, Pose Refinement)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import TrackingConfig
from thegra_core.geometry import poses
from thegra_core.geometry.camera import CameraModel
from thegra_core.map.landmarks import LandmarkStore

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class VisibleLandmarks:
    """Landmarks that a camera should see: ids (V,), their raw pixels (V, 2) and descriptors (V, D)."""

    ids: IntArray
    pixels: FloatArray
    descriptors: NDArray[np.float32] | NDArray[np.uint8]


def visible_landmarks(
    landmarks: LandmarkStore, ids: IntArray, camera_from_world: FloatArray, camera: CameraModel, config: TrackingConfig
) -> VisibleLandmarks:
    """Of the landmarks `ids` (all alive) those that pass (i) projection in the image, (ii) the viewing angle, (iii) the distance range."""
    rows = landmarks.rows(ids)
    points = landmarks.points_world[rows] if len(rows) else np.empty((0, 3))
    points_camera = poses.apply(camera_from_world, points)
    center = poses.inverse(camera_from_world)[:3, 3]
    rays = points - center
    distance = np.linalg.norm(rays, axis=1)
    cosine = np.einsum("ni,ni->n", rays, landmarks.column("normals")[rows]) / np.maximum(distance, 1e-12) if len(rows) else np.empty(0)
    ok = points_camera[:, 2] > 0
    if len(rows):
        ok &= cosine > np.cos(np.radians(config.max_view_angle_deg))
        ok &= distance > landmarks.column("depth_min")[rows] / config.depth_margin
        ok &= distance < landmarks.column("depth_max")[rows] * config.depth_margin
    # beyond the image's own corners a radial polynomial can turn back and put a far-off point inside the image
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = np.linalg.norm(points_camera[:, :2], axis=1) / points_camera[:, 2]
    ok &= radius < 1.05 * camera.max_radius
    pixels = np.full((len(ids), 2), np.nan)
    pixels[ok] = camera.project(points_camera[ok])
    ok &= camera.contains(pixels)
    keep = np.flatnonzero(ok)
    descriptors = landmarks.column("descriptors")[rows[keep]] if len(keep) else np.empty((0, 1), np.float32)
    return VisibleLandmarks(ids[keep], pixels[keep], descriptors)


def match_by_projection(
    visible: VisibleLandmarks,
    keypoints: NDArray[np.float32],
    descriptors: NDArray[np.float32] | NDArray[np.uint8],
    free: NDArray[np.bool_],
    radius_px: float,
    min_similarity: float,
    ratio: float,
) -> tuple[IntArray, IntArray]:
    """Pair landmarks with free keypoints near their projections by descriptor: indices into `visible` and into keypoints, one to one.

    keypoints (N, 2) raw px; free (N,) bool. A pair must be the most similar for both sides, similar enough, and its distance
    (1 - similarity) below `ratio` times that of the landmark's second-best keypoint in the radius.
    """
    candidates = np.flatnonzero(free)
    if len(visible.ids) == 0 or len(candidates) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    near_landmark, near_keypoint = _pairs_within(visible.pixels, keypoints[candidates].astype(np.float64), radius_px)
    if len(near_landmark) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    similarity = descriptor_similarity(visible.descriptors[near_landmark], descriptors[candidates[near_keypoint]])
    order = np.lexsort((near_keypoint, -similarity, near_landmark))
    near_landmark, near_keypoint, similarity = near_landmark[order], near_keypoint[order], similarity[order]
    first = np.flatnonzero(np.diff(near_landmark, prepend=-1))
    second = np.full(len(first), -1.0)
    has_second = np.diff(np.append(first, len(near_landmark))) > 1
    second[has_second] = similarity[first[has_second] + 1]
    good = (similarity[first] >= min_similarity) & (1 - similarity[first] < ratio * (1 - second))
    landmark, keypoint, best = near_landmark[first][good], near_keypoint[first][good], similarity[first][good]
    by_keypoint = np.lexsort((landmark, -best, keypoint))
    unique = by_keypoint[np.flatnonzero(np.diff(keypoint[by_keypoint], prepend=-1))]
    unique.sort()
    return landmark[unique], candidates[keypoint[unique]]


def descriptor_similarity(a: NDArray[Any], b: NDArray[Any]) -> FloatArray:
    """(N,) cosine of float descriptors (N, D) of unit norm; 1 - 2 * Hamming share of binary ones (N, D) uint8."""
    if a.dtype == np.uint8:
        bits = np.unpackbits(np.bitwise_xor(a, b), axis=1).sum(axis=1)
        return np.asarray(1.0 - 2.0 * bits / (8 * a.shape[1]))
    return np.asarray(np.einsum("nd,nd->n", a, b), dtype=np.float64)


def _pairs_within(a: FloatArray, b: FloatArray, radius: float) -> tuple[IntArray, IntArray]:
    """Index pairs of points (N, 2), (M, 2) at most `radius` apart, found along sorted x."""
    order = np.argsort(b[:, 0], kind="stable")
    x = b[order, 0]
    begin, end = np.searchsorted(x, a[:, 0] - radius), np.searchsorted(x, a[:, 0] + radius, side="right")
    count = end - begin
    left = np.repeat(np.arange(len(a)), count)
    offset = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    right = order[np.repeat(begin, count) + offset]
    near = ((a[left] - b[right]) ** 2).sum(axis=1) <= radius * radius
    return left[near], right[near]
