"""SIFT (Lowe 2004) with RootSIFT descriptors (Arandjelovic and Zisserman 2012), and ORB (Rublee et al. 2011), by OpenCV."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from thegra_core.config import ExtractorConfig
from thegra_core.features.assemble import assemble, scaled_image
from thegra_core.messages import Features

# With detection_threshold 0 the strongest points are wanted whatever their contrast; these only keep sensor noise out.
SIFT_CONTRAST = 0.01
ORB_FAST = 5
ORB_SCALE = 1.2
_ORB_SURPLUS = 2


class Sift:
    """`Extractor`: 128-D RootSIFT of unit norm; a point with several orientations is kept once, under its strongest response."""

    def __init__(self, config: ExtractorConfig) -> None:
        self.name: str = config.name
        self._config = config
        contrast = config.detection_threshold or SIFT_CONTRAST
        self._sift = cv2.SIFT.create(nfeatures=0, contrastThreshold=contrast, enable_precise_upscale=True)

    def extract(self, image: NDArray[np.uint8], stamp_ns: int) -> Features:
        """See `Extractor.extract`."""
        scaled, scale = scaled_image(image, self._config.long_side)
        found = _first_at_each_place(self._sift.detect(scaled, None), 2 * self._config.max_keypoints)
        described, descriptors = self._sift.compute(scaled, found) if found else ((), None)
        root = _root_sift(np.asarray(descriptors, np.float32)) if described else np.empty((0, 128), np.float32)
        return assemble(self._config, stamp_ns, (image.shape[1], image.shape[0]), scale, _pixels(described), _relative_response(described), root)


class Orb:
    """`Extractor`: 256-bit ORB as 32 bytes, detected on a pyramid of eight levels."""

    def __init__(self, config: ExtractorConfig) -> None:
        self.name: str = config.name
        self._config = config
        threshold = round(config.detection_threshold) or ORB_FAST
        self._orb = cv2.ORB.create(nfeatures=_ORB_SURPLUS * config.max_keypoints, scaleFactor=ORB_SCALE, fastThreshold=threshold)

    def extract(self, image: NDArray[np.uint8], stamp_ns: int) -> Features:
        """See `Extractor.extract`."""
        scaled, scale = scaled_image(image, self._config.long_side)
        found, descriptors = self._orb.detectAndCompute(scaled, None)
        binary = np.asarray(descriptors, np.uint8) if descriptors is not None else np.empty((0, 32), np.uint8)
        # OpenCV multiplies level pixels by the level's scale; pixel centres move by half a step besides
        steps = ORB_SCALE ** np.asarray([point.octave for point in found], np.float32)
        keypoints = _pixels(found) + 0.5 * (steps[:, None] - 1)
        return assemble(self._config, stamp_ns, (image.shape[1], image.shape[0]), scale, keypoints, _relative_response(found), binary)


def _first_at_each_place(found: Sequence[cv2.KeyPoint], count: int) -> list[cv2.KeyPoint]:
    places: dict[tuple[float, float], cv2.KeyPoint] = {}
    for point in sorted(found, key=lambda point: -point.response):
        places.setdefault((point.pt[0], point.pt[1]), point)
    return list(places.values())[:count]


def _pixels(found: Sequence[cv2.KeyPoint]) -> NDArray[np.float32]:
    return np.asarray([point.pt for point in found], np.float32).reshape(-1, 2)


def _relative_response(found: Sequence[cv2.KeyPoint]) -> NDArray[np.float32]:
    responses = np.asarray([point.response for point in found], np.float32)
    largest = responses.max(initial=0)
    return np.asarray(responses / largest, np.float32) if largest > 0 else np.ones_like(responses)


def _root_sift(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    shares = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), np.float32(1e-12))
    return np.asarray(np.sqrt(shares), np.float32)
