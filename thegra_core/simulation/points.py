"""A street of points with unmistakable descriptors, and a front end that sees them: hours of frames for what comes behind the front end, without images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry import poses
from thegra_core.geometry.camera import CameraModel, DistortionModel
from thegra_core.messages import Features, Matches

FloatArray = NDArray[np.float64]

CAMERA = CameraModel(np.array([[520.0, 0, 319.5], [0, 520.0, 255.5], [0, 0, 1]]), np.zeros(4), DistortionModel.PLUMB_BOB, (640, 512))
NEAR, FAR, HALF_HEIGHT = 3.0, 8.0, 3.0
"""Depths and half the height of the points beside the way, in units of the world."""
SEEN, NOISE_PX = 0.9, 0.3
"""Share of the points in view that a frame detects, and the standard deviation of their keypoints."""
DESCRIPTOR = 128
"""Numbers of a descriptor: those of ALIKED."""
_SAME = 0.9


@dataclass(frozen=True)
class PointStreet:
    """A camera goes along the x axis and looks to its side, at `speed` units a frame, swaying a little.

    Args:
        frames: How many; the street is as long as they need.
        keypoints: Of a frame, about.
        seed: Of points and noise.
    """

    frames: int
    keypoints: int = 300
    speed: float = 0.05
    seed: int = 0
    points: FloatArray = field(init=False)
    descriptors: NDArray[np.float32] = field(init=False)
    scores: NDArray[np.float32] = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        half_width, half_height = (0.5 * size / CAMERA.focal for size in CAMERA.image_size)
        seen_volume = 4 * half_width * half_height * (FAR**3 - NEAR**3) / 3  # somewhat more than it is: the highest points are cut off
        length = self.frames * self.speed + 4 * FAR
        count = int(self.keypoints / SEEN / seen_volume * length * 2 * HALF_HEIGHT * (FAR - NEAR))
        points = rng.uniform((-2 * FAR, -HALF_HEIGHT, NEAR), (length - 2 * FAR, HALF_HEIGHT, FAR), (count, 3))
        descriptors = rng.normal(size=(count, DESCRIPTOR)).astype(np.float32)
        object.__setattr__(self, "points", points[np.argsort(points[:, 0])])
        object.__setattr__(self, "descriptors", descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True))
        object.__setattr__(self, "scores", rng.uniform(0.05, 0.6, count).astype(np.float32))

    def world_from_camera(self, index: int) -> FloatArray:
        """True pose (4, 4) of a frame."""
        sway = 0.02 * index
        rotation = poses.so3_exp(np.array([0.02 * np.sin(1.3 * sway), 0.1 * np.sin(sway), 0.0]))
        return poses.transform(rotation, [self.speed * index, 0.1 * np.sin(0.7 * sway), 0.3 * np.sin(0.4 * sway)])

    def see(self, index: int, stamp_ns: int) -> Features:
        """What a front end finds in a frame, in random order; always the same for the same frame."""
        rng = np.random.default_rng((self.seed, index))
        pose = self.world_from_camera(index)
        begin, end = np.searchsorted(self.points[:, 0], pose[0, 3] + np.array([-2.0, 2.0]) * FAR)
        local = poses.apply(poses.inverse(pose), self.points[begin:end])
        pixels = CAMERA.project(local)
        rows = np.flatnonzero((local[:, 2] > 0) & CAMERA.contains(pixels, 2.0) & (rng.random(len(local)) < SEEN))
        rows = rng.permutation(rows)
        keypoints = (pixels[rows] + rng.normal(0, NOISE_PX, (len(rows), 2))).astype(np.float32)
        return Features(stamp_ns, keypoints, self.scores[begin + rows], self.descriptors[begin + rows], CAMERA.image_size, "points")


@dataclass
class StreetExtractor:
    """`Extractor` that gives one frame of the street after the other, whatever the images show."""

    street: PointStreet
    name: str = "points"
    _next: int = 0

    def extract(self, image: NDArray[np.uint8], stamp_ns: int) -> Features:
        """See `Extractor.extract`."""
        self._next += 1
        return self.street.see(self._next - 1, stamp_ns)


@dataclass
class EqualDescriptors:
    """`Matcher` that pairs what has the same descriptor."""

    name: str = "equal"

    def match(self, query: Features, reference: Features) -> Matches:
        """See `Matcher.match`."""
        if len(query) == 0 or len(reference) == 0:
            return Matches(query.stamp_ns, reference.stamp_ns, np.empty((0, 2), np.int32), np.empty(0, np.float32))
        similarity = query.descriptors @ reference.descriptors.T
        best = similarity.argmax(axis=1)
        rows = np.flatnonzero(similarity[np.arange(len(query)), best] > _SAME)
        indices = np.stack([rows, best[rows]], axis=1).astype(np.int32)
        return Matches(query.stamp_ns, reference.stamp_ns, indices, np.full(len(rows), 0.9, np.float32))

    def match_many(self, query: Features, references: Sequence[Features]) -> list[Matches]:
        """See `Matcher.match_many`."""
        return [self.match(query, reference) for reference in references]
