"""Linear maps of a window of grey levels to 8 bit. Each is its limits, told by a pure function, and one map that all share.

Limits apart from the map let a stream carry them from frame to frame (`stability`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thegra_core.messages import ImageArray

PAPER_TAIL = 10000 / (640 * 512)
"""Share of the pixels beyond each limit: the paper's cumulative pixel count of 10000 on its cameras' images."""


def he_clip(image: ImageArray, tail_fraction: float = PAPER_TAIL, fold: bool = False) -> NDArray[np.uint8]:
    """Two-tail clip and linear map to uint8: the paper's "histogram equalisation, cumulative pixel count 10000".

    Args:
        image: Any of the three types.
        tail_fraction: Share of the pixels beyond each limit.
        fold: Mirror what is below the lower limit instead of clamping it, as the authors' script did.
    """
    return map_window(image, tail_limits(image, tail_fraction), fold)


def stretch(image: ImageArray, low: float = 1.0, high: float = 99.0) -> NDArray[np.uint8]:
    """Linear map of the values between two percentiles to uint8."""
    return map_window(image, percentile_limits(image, low, high))


def kelvin_window(
    image: ImageArray, low_k: float = 283.15, high_k: float = 313.15, kelvin_per_count: float = 0.01, kelvin_at_zero: float = 0.0
) -> NDArray[np.uint8]:
    """Linear map of a fixed range of temperatures to uint8, for radiometric streams: the same temperature has the same grey level in every frame.

    Args:
        image: Counts; temperature is `kelvin_at_zero + kelvin_per_count * counts` (Lepton and Boson TLinear: 0.01 or 0.1 K a count).
        low_k: Temperature that becomes 0, K.
        high_k: Temperature that becomes 255, K.
        kelvin_per_count: K.
        kelvin_at_zero: K.
    """
    return map_window(image, ((low_k - kelvin_at_zero) / kelvin_per_count, (high_k - kelvin_at_zero) / kelvin_per_count))


def tail_limits(image: ImageArray, tail_fraction: float = PAPER_TAIL) -> tuple[float, float]:
    """The values at which the cumulative histogram, from below and from above, reaches `tail_fraction` of the pixels.

    Value 0 marks missing pixels in an integer image and does not count from below; in a float image every pixel counts.
    """
    count = max(1, round(tail_fraction * image.size))
    return _limits_float(image, count) if image.dtype == np.float32 else _limits_integer(image, count)


def percentile_limits(image: ImageArray, low: float = 1.0, high: float = 99.0) -> tuple[float, float]:
    """The values at two percentiles."""
    below, above = np.percentile(image, [low, high])
    return float(below), float(above)


def map_window(image: ImageArray, limits: tuple[float, float], fold: bool = False) -> NDArray[np.uint8]:
    """`limits` to 0 and 255, clamped; with `fold` what is below the lower limit is mirrored at it. An empty window gives 0 and 255 on its sides."""
    low, high = limits
    if not high > low:
        return np.where(image > high, np.uint8(255), np.uint8(0)).astype(np.uint8)
    scale = 255.0 / (high - low)
    values = (image.astype(np.float32) - np.float32(low)) * np.float32(scale)
    if fold:
        np.abs(values, out=values)
    np.rint(values, out=values)
    return np.clip(values, 0, 255, out=values).astype(np.uint8)


def _limits_integer(image: ImageArray, count: int) -> tuple[float, float]:
    histogram = np.bincount(image.ravel(), minlength=2)
    from_above = np.cumsum(histogram[::-1])
    high = len(histogram) - 1 - int(np.searchsorted(from_above, min(count, image.size)))
    histogram[0] = 0
    from_below = np.cumsum(histogram)
    low = int(np.searchsorted(from_below, min(count, max(int(from_below[-1]), 1))))
    return float(min(low, len(histogram) - 1)), float(high)


def _limits_float(image: ImageArray, count: int) -> tuple[float, float]:
    count = min(count, image.size)
    ordered = np.partition(image.ravel(), (count - 1, image.size - count))
    return float(ordered[count - 1]), float(ordered[image.size - count])
