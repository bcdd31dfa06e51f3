"""What all extractors share: the image as the network wants it, and raw detections as `Features` that keep the contract."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from thegra_core.config import ExtractorConfig
from thegra_core.errors import InputError
from thegra_core.features.detection import spread
from thegra_core.messages import Features

MIN_SCORE = np.float32(1e-6)
"""Scores are in (0, 1]: weights divide by them."""


def scaled_image(image: NDArray[np.uint8], long_side: int | None) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """The image with its long side brought to `long_side`, and the scale (x, y) that was applied.

    Raises:
        InputError: If the image is not (H, W) uint8.
    """
    if image.ndim != 2 or image.dtype != np.uint8 or image.size == 0:
        raise InputError(f"feature extraction takes a single-channel 8-bit image, got shape {image.shape}, {image.dtype}")
    height, width = image.shape
    if long_side is None or long_side == max(height, width):
        return image, (1.0, 1.0)
    factor = long_side / max(height, width)
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    interpolation = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    resized = cv2.resize(image, size, interpolation=interpolation)
    return np.asarray(resized, np.uint8), (size[0] / width, size[1] / height)


def assemble(
    config: ExtractorConfig,
    stamp_ns: int,
    image_size: tuple[int, int],
    scale: tuple[float, float],
    keypoints: NDArray[np.float32],
    scores: NDArray[np.float32],
    descriptors: NDArray[np.float32] | NDArray[np.uint8],
) -> Features:
    """Detections of the scaled image as features of the raw one: finite, inside the border, strongest first, at most `max_keypoints`.

    Args:
        image_size: (width, height) of the raw image.
        scale: What `scaled_image` applied; pixel centres map by k_raw = (k + 0.5) / scale - 0.5.
        keypoints: (N, 2) pixels of the scaled image.
        scores: (N,), clipped into (0, 1].
        descriptors: (N, D) float32 or uint8.
    """
    usable = np.asarray(np.isfinite(descriptors).all(axis=1))
    raw, chosen = selected(config, image_size, scale, keypoints, scores, usable)
    return described(config, stamp_ns, image_size, raw, scores[chosen], descriptors[chosen])


def selected(
    config: ExtractorConfig, image_size: tuple[int, int], scale: tuple[float, float], keypoints: NDArray[np.float32], scores: NDArray[np.float32], usable: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The first part of `assemble`, for what is described only once it is chosen: of the detections that are `usable` (N,) those that stay, as pixels (M, 2) of the
    raw image and as rows (M,)."""
    raw = keypoints.astype(np.float64)
    if scale != (1.0, 1.0):
        raw = (raw + 0.5) / np.asarray(scale) - 0.5
    limits = np.asarray(image_size, np.float64) - 1 - config.border
    keep = usable & np.isfinite(raw).all(axis=1) & np.isfinite(scores) & (raw >= config.border).all(axis=1) & (raw <= limits).all(axis=1)
    chosen = np.flatnonzero(keep)
    chosen = chosen[spread(raw[chosen], scores[chosen], config.max_keypoints, image_size, config.crowding)]
    return raw[chosen], chosen


def described(
    config: ExtractorConfig, stamp_ns: int, image_size: tuple[int, int], raw: NDArray[np.float64], scores: NDArray[np.float32], descriptors: NDArray[np.float32] | NDArray[np.uint8],
) -> Features:  # fmt: skip
    """The second part of `assemble`: pixels (M, 2) of the raw image, scores (M,) and descriptors (M, D) as features."""
    return Features(
        stamp_ns=stamp_ns,
        keypoints=np.ascontiguousarray(raw, np.float32),
        scores=np.clip(scores.astype(np.float32), MIN_SCORE, np.float32(1)),
        descriptors=descriptors,
        image_size=image_size,
        extractor=config.name,
    )
