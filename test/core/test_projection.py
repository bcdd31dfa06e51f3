"""The three visibility tests one by one, and the search near projections against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thegra_core.config import TrackingConfig
from thegra_core.geometry import poses
from thegra_core.geometry.camera import CameraModel, DistortionModel
from thegra_core.map.landmarks import LandmarkStore
from thegra_core.map.projection import VisibleLandmarks, descriptor_similarity, match_by_projection, visible_landmarks
from thegra_core.messages import LandmarkArrays

CAMERA = CameraModel(np.array([[500.0, 0, 320], [0, 500, 256], [0, 0, 1]]), np.zeros(5), DistortionModel.PLUMB_BOB, (641, 513))
CONFIG = TrackingConfig()  # 60 degrees, distances within a factor of 2


def store(points: np.ndarray, normals: np.ndarray | None = None, depth_min: float = 0.001, depth_max: float = 1000.0) -> LandmarkStore:
    """Landmarks 0..N-1; normals default to the ray from the origin."""
    count = len(points)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True) if normals is None else normals
    landmarks = LandmarkStore()
    landmarks.put(
        LandmarkArrays(
            np.arange(count), points, rays, np.full(count, depth_min), np.full(count, depth_max), np.eye(count, 64, dtype=np.float32), np.ones(count, np.float32)
        )
    )
    return landmarks


def seen(landmarks: LandmarkStore, camera_from_world: np.ndarray | None = None, camera: CameraModel = CAMERA, config: TrackingConfig = CONFIG) -> list[int]:
    pose = np.eye(4) if camera_from_world is None else camera_from_world
    return visible_landmarks(landmarks, landmarks.alive_ids(), pose, camera, config).ids.tolist()


def test_image_bounds() -> None:
    # at z = 2 one pixel is 0.004 wide; the corners are exactly at +-1.28 and +-1.024
    points = np.array([[1.28, 1.024, 2], [-1.28, -1.024, 2], [1.281, 0, 2], [0, -1.025, 2], [0, 0, -2], [0.1, 0.1, 0]])
    assert seen(store(points)) == [0, 1]


def test_viewing_angle() -> None:
    """A landmark straight ahead, first seen from directions 0, 59.9, 60.1 and 180 degrees away."""
    angles = np.radians([0.0, 59.9, 60.1, 180.0])
    normals = np.stack([np.sin(angles), np.zeros(4), np.cos(angles)], axis=1)
    assert seen(store(np.tile([0.0, 0.0, 2.0], (4, 1)), normals)) == [0, 1]
    assert seen(store(np.tile([0.0, 0.0, 2.0], (4, 1)), normals), config=TrackingConfig(max_view_angle_deg=61.0)) == [0, 1, 2]


def test_viewing_angle_is_at_the_landmark_and_not_at_the_camera() -> None:
    """The direction is the one between camera centre and landmark; turning the camera on the spot changes nothing."""
    landmarks = store(np.array([[0.5, 0.0, 2.0]]), np.array([[0.5, 0, 2.0]]) / np.hypot(0.5, 2))
    assert seen(landmarks, poses.transform(poses.so3_exp([0, 0.3, 0]), [0, 0, 0])) == [0]
    beside = poses.inverse(poses.transform(poses.so3_exp([0, -1.2, 0]), [4.0, 0, 0.4]))  # looks at the landmark from the side
    assert seen(landmarks, beside, config=TrackingConfig(max_view_angle_deg=90)) == [0]
    assert seen(landmarks, beside) == []


@pytest.mark.parametrize(("distance", "expected"), [(1.51, [0]), (1.49, []), (9.9, [0]), (10.1, [])])
def test_distance_range(distance: float, expected: list[int]) -> None:
    """Observed at 3 to 5; the margin of 2 makes 1.5 to 10."""
    landmarks = store(np.array([[0.0, 0.0, 20.0]]), np.array([[0.0, 0, 1]]), depth_min=3.0, depth_max=5.0)
    assert seen(landmarks, poses.inverse(poses.transform(np.eye(3), [0, 0, 20.0 - distance]))) == expected


def test_distance_is_not_the_depth() -> None:
    landmarks = store(np.array([[0.9, 0.0, 1.45]]), depth_min=3.0, depth_max=5.0)  # z under 1.5, distance 1.71
    assert seen(landmarks) == [0]


@pytest.mark.parametrize(("k1", "focal"), [(-0.2, 620), (-0.3, 620), (-0.43, 620), (-0.43, 701)])
def test_points_that_a_folding_distortion_puts_into_the_image_are_not_visible(k1: float, focal: float) -> None:
    """Whatever is called visible is where its pixel's ray says; nothing from beyond the fold comes in."""
    camera = CameraModel(np.array([[focal, 0, 320], [0, focal, 256], [0, 0, 1]]), np.array([k1]), DistortionModel.PLUMB_BOB, (641, 513))
    assert np.isfinite(camera.max_radius)
    radii = np.linspace(0.05, 6.0, 1500)
    directions = np.radians([0.0, 17.0, 38.7, 90.0])
    points = np.concatenate([np.stack([radii * np.cos(a), radii * np.sin(a), np.ones_like(radii)], axis=1) for a in directions])
    found = visible_landmarks(store_plain(points), np.arange(len(points)), np.eye(4), camera, CONFIG)
    assert 100 < len(found.ids) < len(points)
    np.testing.assert_allclose(camera.undistort(found.pixels), points[found.ids, :2], atol=1e-3)
    inside = camera.contains(camera.project(points)) & (np.linalg.norm(points[:, :2], axis=1) <= camera.max_radius)
    assert np.isin(np.flatnonzero(inside), found.ids).all()


def store_plain(points: np.ndarray) -> LandmarkStore:
    landmarks = LandmarkStore()
    count = len(points)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    landmarks.put(LandmarkArrays(np.arange(count), points, rays, np.full(count, 0.01), np.full(count, 100.0), np.ones((count, 2), np.float32), np.ones(count, np.float32)))
    return landmarks


def test_pixels_and_descriptors_belong_to_the_ids() -> None:
    points = np.array([[5.0, 0, 1], [0.2, 0.1, 2.0], [0, 0, -1], [-0.4, 0.3, 3.0]])
    landmarks = store(points)
    found = visible_landmarks(landmarks, np.array([3, 0, 1, 2]), np.eye(4), CAMERA, CONFIG)
    assert found.ids.tolist() == [3, 1]
    np.testing.assert_allclose(found.pixels, CAMERA.project(points[[3, 1]]))
    np.testing.assert_array_equal(found.descriptors, np.eye(4, 64)[[3, 1]])


def test_nothing_to_project() -> None:
    assert len(visible_landmarks(LandmarkStore(), np.empty(0, np.int64), np.eye(4), CAMERA, CONFIG).ids) == 0
    assert seen(store(np.array([[0.0, 0, -1.0]]))) == []


# ---- the search near projections -----------------------------------------------------------------------------------------------------


def unit(rows: list[list[float]]) -> np.ndarray:
    table = np.array(rows, dtype=np.float32)
    return table / np.linalg.norm(table, axis=1, keepdims=True)


def search(
    pixels: list[list[float]], wanted: np.ndarray, keypoints: list[list[float]], descriptors: np.ndarray,
    free: list[bool] | None = None, radius: float = 4.0, similarity: float = 0.75, ratio: float = 0.9,
) -> list[tuple[int, int]]:  # fmt: skip
    visible = VisibleLandmarks(np.arange(len(pixels)) + 100, np.array(pixels, dtype=np.float64).reshape(-1, 2), wanted)
    usable = np.ones(len(keypoints), dtype=bool) if free is None else np.array(free)
    a, b = match_by_projection(visible, np.array(keypoints, np.float32).reshape(-1, 2), descriptors, usable, radius, similarity, ratio)
    return list(zip(a.tolist(), b.tolist(), strict=True))


ONE, OTHER = [1.0, 0, 0], [0, 1.0, 0]


def test_radius_is_round_and_closed() -> None:
    descriptor = unit([ONE])
    assert search([[10, 10]], descriptor, [[14, 10]], descriptor) == [(0, 0)]
    assert search([[10, 10]], descriptor, [[14.01, 10]], descriptor) == []
    assert search([[10, 10]], descriptor, [[13, 13]], descriptor) == []


def test_similarity_has_a_least() -> None:
    wanted = unit([ONE])
    assert search([[0, 0]], wanted, [[0, 0]], unit([[0.76, np.sqrt(1 - 0.76**2), 0]])) == [(0, 0)]
    assert search([[0, 0]], wanted, [[0, 0]], unit([[0.74, np.sqrt(1 - 0.74**2), 0]])) == []


def test_ratio_of_best_to_second_best() -> None:
    """Distances (1 - similarity) 0.10 and 0.12 are too alike for a ratio of 0.8; the nearer pixel does not count."""
    near, second = [0.90, np.sqrt(1 - 0.90**2), 0], [0.88, np.sqrt(1 - 0.88**2), 0]
    assert search([[0, 0]], unit([ONE]), [[3, 0], [0, 0]], unit([near, second]), ratio=0.8) == []
    assert search([[0, 0]], unit([ONE]), [[3, 0], [0, 0]], unit([near, second]), ratio=0.9) == [(0, 0)]
    assert search([[0, 0]], unit([ONE]), [[3, 0], [9, 0]], unit([near, second]), ratio=0.1) == [(0, 0)], "beyond the radius there is no second"


def test_taken_keypoints_are_left_alone() -> None:
    both = unit([ONE, [0.9, np.sqrt(1 - 0.81), 0]])
    assert search([[0, 0]], unit([ONE]), [[0, 0], [1, 0]], both, free=[False, True]) == [(0, 1)]
    assert search([[0, 0]], unit([ONE]), [[0, 0], [1, 0]], both, free=[False, False]) == []


def test_one_keypoint_goes_to_the_more_similar_landmark() -> None:
    wanted = unit([[0.9, np.sqrt(1 - 0.81), 0], ONE])
    assert search([[0, 0], [2, 0]], wanted, [[1, 0]], unit([ONE])) == [(1, 0)]


def test_nothing_to_search() -> None:
    assert search([], np.empty((0, 3), np.float32), [[1, 1]], unit([ONE])) == []
    assert search([[1, 1]], unit([ONE]), [], np.empty((0, 3), np.float32)) == []


def test_similarity_of_binary_descriptors() -> None:
    a = np.array([[0b11110000, 0xFF], [0, 0]], np.uint8)
    b = np.array([[0b11000000, 0xFF], [0xFF, 0xFF]], np.uint8)
    np.testing.assert_allclose(descriptor_similarity(a, b), [1 - 2 * 2 / 16, -1.0])
    np.testing.assert_allclose(descriptor_similarity(unit([ONE, OTHER]), unit([ONE, ONE])), [1.0, 0.0])


@settings(deadline=None, max_examples=80)
@given(st.integers(0, 2**31 - 1), st.integers(0, 25), st.integers(0, 25), st.floats(0.5, 1.0), st.floats(-0.5, 0.9))
def test_search_is_the_brute_force(seed: int, landmarks: int, keypoints: int, ratio: float, similarity: float) -> None:
    rng = np.random.default_rng(seed)
    pixels, points = rng.uniform(0, 20, (landmarks, 2)), rng.uniform(0, 20, (keypoints, 2)).astype(np.float32)
    wanted = rng.normal(size=(landmarks, 4)).astype(np.float32)
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    offered = rng.normal(size=(keypoints, 4)).astype(np.float32)
    offered /= np.linalg.norm(offered, axis=1, keepdims=True)
    free = rng.random(keypoints) < 0.8
    found = search(pixels.tolist(), wanted, points.tolist(), offered, free.tolist(), 4.0, similarity, ratio)

    claims: dict[int, tuple[float, int]] = {}
    for i in range(landmarks):
        near = [j for j in range(keypoints) if free[j] and np.linalg.norm(pixels[i] - points[j].astype(np.float64)) <= 4.0]
        if not near:
            continue
        ordered = sorted(((float(np.einsum("d,d->", wanted[i], offered[j])), j) for j in near), reverse=True)
        best, j = ordered[0]
        second = ordered[1][0] if len(ordered) > 1 else -1.0
        if best >= similarity and 1 - best < ratio * (1 - second) and (j not in claims or best > claims[j][0]):
            claims[j] = (best, i)
    assert sorted(found) == sorted((i, j) for j, (_, i) in claims.items())
    assert len({i for i, _ in found}) == len({j for _, j in found}) == len(found)
