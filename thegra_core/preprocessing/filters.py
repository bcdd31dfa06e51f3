"""Image filters of the paper (Sec. III-B) and of the work it compares with: pure functions from (H, W) uint8, uint16 or float32 to one of these.

Every function leaves its input alone and accepts constant images. The maps to 8 bit are in `windows`, the repair of the sensor's faults in `repair`.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thegra_core.messages import ImageArray
from thegra_core.preprocessing import chambolle
from thegra_core.preprocessing.noise import noise_sigma

_LEVELS_16 = 65536


def chambolle_tv(
    image: ImageArray, weight: float = 4.0, unit: str = "grey_levels", eps: float = 2e-4, max_iterations: int = 200
) -> NDArray[np.float32]:
    """Total-variation denoising (Chambolle 2004), to float32; equals scikit-image's on the same values as floats.

    Args:
        image: Any of the three types; values are taken as they are.
        weight: In `unit`s.
        unit: "grey_levels" of `image`, or "noise": standard deviations of its noise. The same weight in grey levels leaves the noise of one sensor
            and takes the scene of another.
        eps: Stops when the cost changes by less than this share of its first value.
        max_iterations: At the most.
    """
    values = image.astype(np.float32)
    if unit == "noise":
        weight *= noise_sigma(image)
    if weight <= 0 or values.min() == values.max():
        return values
    return chambolle.denoise(values, weight, eps, max_iterations)


def he_cdf(image: ImageArray) -> NDArray[np.uint8]:
    """Histogram equalisation by the cumulative distribution, to uint8; float images are first put on 65536 levels between their extremes."""
    if image.dtype == np.uint8:
        return np.asarray(cv2.equalizeHist(image), dtype=np.uint8)
    levels = _to_16_bit(image) if image.dtype == np.float32 else image
    cumulative = np.cumsum(np.bincount(levels.ravel(), minlength=_LEVELS_16))
    first = cumulative[levels.min()]
    if first == levels.size:
        return np.zeros(image.shape, np.uint8)
    table = np.rint(np.maximum(cumulative - first, 0) * (255.0 / (levels.size - first))).astype(np.uint8)
    return np.asarray(table[levels], dtype=np.uint8)


def clahe(image: ImageArray, clip_limit: float = 2.0, tiles: int = 8) -> ImageArray:
    """Contrast-limited adaptive histogram equalisation, uint8 to uint8; other types give uint16, float ones being first put on 65536 levels."""
    levels = _to_16_bit(image) if image.dtype == np.float32 else image
    result: NDArray[Any] = cv2.createCLAHE(clip_limit, (tiles, tiles)).apply(levels)
    return result


def median(image: ImageArray, size: int = 3) -> ImageArray:
    """Median of a size x size window, size 3 or 5; the type stays."""
    result: NDArray[Any] = cv2.medianBlur(image, size)
    return result


def band_pass(image: ImageArray, low: float = 0.0, high: float = 87.0) -> ImageArray:
    """Keep the spatial frequencies whose distance from the centre of the spectrum is in [low, high] bins; then the magnitude.

    uint8 stays uint8, other types give float32.
    """
    height, width = image.shape
    v = np.fft.fftfreq(height, 1 / height)[:, None]
    u = np.fft.rfftfreq(width, 1 / width)[None, :]
    radius2 = u * u + v * v
    spectrum = np.fft.rfft2(image.astype(np.float32))
    spectrum[(radius2 < low * low) | (radius2 > high * high)] = 0
    result = np.abs(np.fft.irfft2(spectrum, image.shape))
    return np.clip(np.rint(result), 0, 255).astype(np.uint8) if image.dtype == np.uint8 else result.astype(np.float32)


def bilateral(image: ImageArray, diameter: int = 4, sigma_color: float = 35.0, sigma_space: float = 35.0) -> ImageArray:
    """Bilateral filter; uint8 stays uint8, other types give float32."""
    values = image if image.dtype == np.uint8 else image.astype(np.float32)
    result: NDArray[Any] = cv2.bilateralFilter(values, diameter, sigma_color, sigma_space)
    return result


def difference_of_gaussians(image: ImageArray, sigma_fine: float = 1.0, sigma_coarse: float = 4.0) -> NDArray[np.float32]:
    """What is between two scales: the image smoothed by `sigma_fine` less the image smoothed by `sigma_coarse`, both px; signed float32."""
    values = image.astype(np.float32)
    fine = cv2.GaussianBlur(values, (0, 0), sigma_fine, borderType=cv2.BORDER_REFLECT)
    coarse = cv2.GaussianBlur(values, (0, 0), sigma_coarse, borderType=cv2.BORDER_REFLECT)
    return np.asarray(fine - coarse, dtype=np.float32)


def _to_16_bit(image: ImageArray) -> NDArray[np.uint16]:
    low, high = float(image.min()), float(image.max())
    scale = (_LEVELS_16 - 1) / (high - low) if high > low else 0.0
    return np.rint((image.astype(np.float64) - low) * scale).astype(np.uint16)
