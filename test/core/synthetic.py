"""A world of points with unmistakable descriptors: features without images, for the stages behind the front end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from thegra_core.geometry import poses
from thegra_core.geometry.camera import CameraModel, DistortionModel
from thegra_core.messages import Features, Matches

CAMERA = CameraModel(np.array([[520.0, 0, 320], [0, 520.0, 256], [0, 0, 1]]), np.array([-0.1, 0.02, 0.0, 0.0]), DistortionModel.PLUMB_BOB, (640, 512))
PERIOD_NS = 33_333_333
BEGIN_NS = 1_700_000_000_123_456_789
EXTRACTOR = "fake"


@dataclass(frozen=True)
class World:
    """points (P, 3); descriptors (P, 32) float32 of unit norm; scores (P,) float32."""

    points: np.ndarray
    descriptors: np.ndarray
    scores: np.ndarray


def make_world(points: np.ndarray, seed: int = 0) -> World:
    rng = np.random.default_rng(seed)
    descriptors = rng.normal(size=(len(points), 32)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    return World(points, descriptors, rng.uniform(0.05, 0.6, len(points)).astype(np.float32))


def cloud(count: int = 300, seed: int = 0, low: Sequence[float] = (-4, -3, 3), high: Sequence[float] = (4, 3, 8)) -> World:
    """Points at all depths."""
    return make_world(np.random.default_rng(seed).uniform(low, high, (count, 3)), seed)


def plane(count: int = 300, seed: int = 0, distance: float = 4.0, tilt_deg: float = 15.0) -> World:
    """Points of one plane, `distance` ahead, tilted about the y axis."""
    flat = np.random.default_rng(seed).uniform(-4, 4, (count, 3)) * [1, 0.8, 0]
    return make_world(flat @ Rotation.from_euler("y", tilt_deg, degrees=True).as_matrix().T + [0, 0, distance], seed)


def room(count: int = 3000, seed: int = 0, size: Sequence[float] = (8, 4, 8), thickness: float = 0.8) -> World:
    """Points in a thick shell along the walls of a box around the origin."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    wall = rng.choice([0, 2], count)
    rows = np.arange(count)
    points[rows, wall] = 0.5 * rng.choice([-1, 1], count)
    points = points * size
    points[rows, wall] *= 1 - rng.uniform(0, thickness, count) / np.abs(points[rows, wall])
    return make_world(points, seed)


def observe(
    world: World, world_from_camera: np.ndarray, stamp_ns: int, noise_px: float = 0.3, seen: float = 1.0, clutter: int = 0, camera: CameraModel = CAMERA
) -> Features:
    """What an extractor would find: projections with noise, a share `seen` of the points in view, `clutter` random keypoints; in random order.

    The randomness comes from the stamp, so that a frame always looks the same.
    """
    rng = np.random.default_rng(stamp_ns % (2**63))
    pixels = camera.project(poses.apply(poses.inverse(world_from_camera), world.points))
    ray_radius = np.linalg.norm(poses.apply(poses.inverse(world_from_camera), world.points)[:, :2], axis=1)
    depth = poses.apply(poses.inverse(world_from_camera), world.points)[:, 2]
    visible = np.flatnonzero(camera.contains(pixels, 2.0) & (ray_radius < camera.max_radius * np.maximum(depth, 1e-9)) & (rng.random(len(pixels)) < seen))
    keypoints = pixels[visible] + rng.normal(0, noise_px, (len(visible), 2))
    random = rng.normal(size=(clutter, 32))
    descriptors = np.concatenate([world.descriptors[visible], random / np.linalg.norm(random, axis=1, keepdims=True)])
    keypoints = np.concatenate([keypoints, rng.uniform((2, 2), np.array(camera.image_size) - 3, (clutter, 2))])
    scores = np.concatenate([world.scores[visible], rng.uniform(0.05, 0.6, clutter)])
    order = rng.permutation(len(keypoints))
    return Features(
        stamp_ns, keypoints[order].astype(np.float32), scores[order].astype(np.float32), descriptors[order].astype(np.float32), camera.image_size, EXTRACTOR
    )


def no_features(stamp_ns: int) -> Features:
    return Features(stamp_ns, np.empty((0, 2), np.float32), np.empty(0, np.float32), np.empty((0, 32), np.float32), CAMERA.image_size, EXTRACTOR)


@dataclass
class FakeMatcher:
    """Matches equal descriptors; a share `wrong` of the matches is exchanged among each other."""

    wrong: float = 0.0
    name: str = "fake"
    calls: int = field(default=0)

    def match(self, query: Features, reference: Features) -> Matches:
        self.calls += 1
        if len(query) == 0 or len(reference) == 0:
            return Matches(query.stamp_ns, reference.stamp_ns, np.empty((0, 2), np.int32), np.empty(0, np.float32))
        similarity = query.descriptors @ reference.descriptors.T
        best = similarity.argmax(axis=1)
        rows = np.flatnonzero(similarity[np.arange(len(query)), best] > 0.99)
        partners = best[rows]
        rng = np.random.default_rng((query.stamp_ns ^ (reference.stamp_ns << 1)) % (2**63))
        mixed = np.flatnonzero(rng.random(len(rows)) < self.wrong)
        partners[mixed] = partners[np.roll(mixed, 1)]
        indices = np.stack([rows, partners], axis=1).astype(np.int32)
        return Matches(query.stamp_ns, reference.stamp_ns, indices, np.full(len(rows), 0.9, np.float32))

    def match_many(self, query: Features, references: Sequence[Features]) -> list[Matches]:
        return [self.match(query, reference) for reference in references]


@dataclass
class FakeExtractor:
    """Features of a world by the stamp of the frame; frames that are not in `poses_by_stamp` show nothing."""

    world: World
    poses_by_stamp: dict[int, np.ndarray]
    noise_px: float = 0.3
    seen: float = 0.9
    clutter: int = 10
    name: str = EXTRACTOR
    images: list[np.ndarray] = field(default_factory=list)

    def extract(self, image: np.ndarray, stamp_ns: int) -> Features:
        self.images.append(image)
        pose = self.poses_by_stamp.get(stamp_ns)
        return no_features(stamp_ns) if pose is None else observe(self.world, pose, stamp_ns, self.noise_px, self.seen, self.clutter)


def stamp(index: int) -> int:
    return BEGIN_NS + index * PERIOD_NS


def look(position: Sequence[float], yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> np.ndarray:
    """world_from_camera of a camera at `position`, turned about its y (yaw), x (pitch) and z (roll) axes."""
    return poses.transform(Rotation.from_euler("YXZ", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_matrix(), position)


def sideways(count: int, step: float = 0.04) -> list[np.ndarray]:
    """A camera that moves right and a little forward, up and around."""
    return [look([step * i, 0.1 * step * i, 0.2 * step * i], -0.2 * i, 0.05 * i, 0.1 * i) for i in range(count)]


def loop(count: int, radius: float = 1.5, turns: float = 1.0) -> list[np.ndarray]:
    """A circle in the xz plane, looking outwards."""
    angles = np.linspace(0, 2 * np.pi * turns, count)
    return [look([radius * np.sin(a), 0.1 * np.sin(3 * a), radius * np.cos(a)], np.degrees(a)) for a in angles]


def motion_error(found: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Degrees between two relative poses: of the rotation, of the direction of translation."""
    rotation = poses.rotation_angle(found[:3, :3].T @ true[:3, :3])
    cosine = found[:3, 3] @ true[:3, 3] / (np.linalg.norm(found[:3, 3]) * np.linalg.norm(true[:3, 3]))
    return float(np.degrees(rotation)), float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
