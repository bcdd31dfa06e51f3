"""The terms of the sensor model: arrays in, arrays out, no state."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Uint8Array = NDArray[np.uint8]
Uint16Array = NDArray[np.uint16]


def blur(kelvin: FloatArray, sigma_px: float) -> FloatArray:
    """Gaussian blur of an image (H, W); 0: as it is."""
    return kelvin if sigma_px == 0 else np.asarray(cv2.GaussianBlur(kelvin, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE))


def dome(shape: tuple[int, int]) -> FloatArray:
    """(H, W) rising with the squared distance from the middle: 0 there, 1 in the corners."""
    height, width = shape
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    return np.asarray((x * x + y * y) / 2)


def correlated_step(field: FloatArray, dt_s: float, time_s: float, rng: np.random.Generator) -> FloatArray:
    """Next value of a field of unit variance whose correlation falls by e in `time_s` (Ornstein-Uhlenbeck, exact for any step)."""
    keep = np.exp(-dt_s / time_s)
    return np.asarray(keep * field + np.sqrt(1 - keep * keep) * rng.standard_normal(field.shape))


def digitize(kelvin: FloatArray, counts_per_kelvin: float, reference_k: float, reference_counts: float, bits: int) -> Uint16Array:
    """Kelvin (H, W) to whole counts, clipped to 0 .. 2^bits - 1."""
    counts = reference_counts + counts_per_kelvin * (kelvin - reference_k)
    return np.clip(np.rint(counts), 0, (1 << bits) - 1).astype(np.uint16)


def stuck_pixels(shape: tuple[int, int], share: float, bits: int, rng: np.random.Generator) -> tuple[NDArray[np.intp], Uint16Array]:
    """Flat indices of dead pixels and the values at which they are stuck: the lowest, the highest, or anything."""
    count = round(share * shape[0] * shape[1])
    where = rng.choice(shape[0] * shape[1], count, replace=False)
    top = (1 << bits) - 1
    values = np.where(rng.random(count) < 0.7, rng.choice([0, top], count), rng.integers(0, top + 1, count))
    return where, values.astype(np.uint16)


def linear_limits(counts: Uint16Array, tail: float) -> tuple[float, float]:
    """Counts between which all but a share `tail` of the pixels at each end lie."""
    low, high = np.quantile(counts, [tail, 1 - tail])
    return float(low), float(max(high, low + 1))


def linear_gain(counts: Uint16Array, limits: tuple[float, float]) -> Uint8Array:
    """Counts (H, W) to 8 bit, `limits` to 0 and 255."""
    low, high = limits
    return np.clip(np.rint((counts.astype(np.float64) - low) * (255.0 / (high - low))), 0, 255).astype(np.uint8)


def plateau_curve(counts: Uint16Array, plateau: float, bits: int) -> FloatArray:
    """Output levels 0..255 (2^bits,) of each count: the cumulative histogram whose bins count for at most `plateau` of the pixels."""
    histogram = np.bincount(counts.ravel(), minlength=1 << bits).astype(np.float64)
    cumulative = np.cumsum(np.minimum(histogram, plateau * counts.size))
    return np.asarray(255.0 * cumulative / cumulative[-1])
