"""The noise of an image, told from the image alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thegra_core.messages import ImageArray

ROWS = 24
"""Rows that are looked at: enough pixels for a steady figure, few enough for half a millisecond."""
EVERY = 4
"""Of those rows' pixels, which take part in medians."""
FINE_GAIN = 1.5**0.5
"""Standard deviation of the second difference of white noise over that of the noise."""
CLIP = 3.0
"""Medians at which second differences are clipped, so that edges count little."""
_CLIPPED_MEAN = 0.7819
"""Mean of a normal variable's magnitude, clipped at three medians, over its standard deviation."""


def sampled_rows(image: ImageArray) -> NDArray[np.float32]:
    """Some rows (R, W) of an image (H, W), evenly spread."""
    step = max(image.shape[0] // ROWS, 1)
    return image[step // 2 :: step].astype(np.float32)


def second_difference(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Each pixel less the mean of its neighbours in the row, (R, W - 2)."""
    return values[:, 1:-1] - np.float32(0.5) * (values[:, :-2] + values[:, 2:])


def clipped(fine: NDArray[np.float32]) -> NDArray[np.float32]:
    """Second differences clipped at three medians of their magnitude."""
    limit = np.float32(CLIP * max(float(np.median(np.abs(fine[:, ::EVERY]))), 1e-6))
    return np.clip(fine, -limit, limit)


def noise_of(fine: NDArray[np.float32]) -> float:
    """Standard deviation of the noise from clipped second differences: the mean, for a median of whole numbers is a whole number."""
    return float(np.mean(np.abs(fine))) / (_CLIPPED_MEAN * FINE_GAIN)


def noise_sigma(image: ImageArray) -> float:
    """Standard deviation (grey levels) of an image's noise, its fixed pattern and finest texture included; images narrower than 3 px have none."""
    if image.shape[1] < 3:
        return 0.0
    return noise_of(clipped(second_difference(sampled_rows(image))))
