"""Time of each filter and of the paper's chain on one thread, beside the same computed with scikit-image, SciPy, OpenCV and plain numpy."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage import exposure, restoration

from thegra_core import config as cfg
from thegra_core.messages import ImageArray
from thegra_core.preprocessing.chain import FILTERS, Chain
from thegra_core.preprocessing.windows import PAPER_TAIL

Reference = Callable[[ImageArray], NDArray[Any]]
ON_8_BIT = ("bilateral", "median")
"""Filters that the paper's chains put after the map to 8 bit, or that libraries offer for 8 bit."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Medians in ms; the reference's is None where no library has the filter."""

    ms: float
    reference_ms: float | None


def benchmark(frames: Sequence[ImageArray], repeats: int = 5, progress: Callable[[str], None] | None = None) -> dict[str, Any]:
    """Time every filter and the chain over `frames` (H, W) uint16, `repeats` times each, ours and the reference in turn so that both meet the same load."""
    say = progress or (lambda _: None)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        filters = {}
        for section in cfg.FILTER_SECTIONS:
            parameters = section().model_dump()
            name = parameters.pop("filter")
            say(name)
            images = [_to_8_bit(f) for f in frames] if name in ON_8_BIT else list(frames)
            filters[name] = _time(functools.partial(FILTERS[name], **parameters), REFERENCES.get(name), images, repeats)
        say("chain")
        chain = Chain(cfg.load_config("paper").preprocessing)
        timing = _time(lambda image: chain(image, 0), reference_chain, list(frames), repeats)
        within = float(np.mean([np.mean(np.abs(chain(f, 0).astype(int) - reference_chain(f)) <= 1) for f in frames]))
    finally:
        cv2.setNumThreads(threads)
    return {
        "frames": len(frames),
        "image_size": [int(frames[0].shape[1]), int(frames[0].shape[0])],
        "filters": {name: {"ms": t.ms, "reference_ms": t.reference_ms} for name, t in filters.items()},
        "chain": {"ms": timing.ms, "reference_ms": timing.reference_ms, "within_one_level_pct": round(100 * within, 4)},
    }


def reference_chain(image: ImageArray) -> NDArray[np.uint8]:
    """The paper's chain as one would write it with scikit-image, numpy and OpenCV."""
    return np.asarray(cv2.medianBlur(_reference_he_clip(_reference_chambolle(image).astype(np.float32)), 3), dtype=np.uint8)


def _time(ours: Reference, reference: Reference | None, images: Sequence[ImageArray], repeats: int) -> Timing:
    mine, theirs = [], []
    for _ in range(repeats):
        for image in images:
            mine.append(_milliseconds(ours, image))
            if reference is not None:
                theirs.append(_milliseconds(reference, image))
    return Timing(round(float(np.median(mine)), 3), round(float(np.median(theirs)), 3) if theirs else None)


def _milliseconds(function: Reference, image: ImageArray) -> float:
    begin = time.perf_counter()
    function(image)
    return 1e3 * (time.perf_counter() - begin)


def _to_8_bit(image: ImageArray) -> NDArray[np.uint8]:
    return np.asarray(FILTERS["he_clip"](image), dtype=np.uint8)


def _reference_chambolle(image: ImageArray) -> NDArray[Any]:
    return np.asarray(restoration.denoise_tv_chambolle(image.astype(np.float64), weight=4.0))


def _reference_he_clip(image: ImageArray) -> NDArray[np.uint8]:
    count = round(PAPER_TAIL * image.size)
    ordered = np.sort(image, axis=None)
    low, high = float(ordered[count - 1]), float(ordered[image.size - count])
    return np.clip(np.rint((image.astype(np.float64) - low) * (255 / max(high - low, 1e-9))), 0, 255).astype(np.uint8)


def _reference_band_pass(image: ImageArray) -> NDArray[Any]:
    height, width = image.shape
    spectrum = np.fft.fftshift(np.fft.fft2(image))
    v, u = np.ogrid[:height, :width]
    spectrum[(v - height // 2) ** 2 + (u - width // 2) ** 2 > 87.0**2] = 0
    return np.abs(np.fft.ifft2(np.fft.ifftshift(spectrum)))


def _reference_gaussians(image: ImageArray) -> NDArray[Any]:
    values = image.astype(np.float64)
    return np.asarray(ndimage.gaussian_filter(values, 1.0) - ndimage.gaussian_filter(values, 4.0))


REFERENCES: dict[str, Reference] = {
    "chambolle_tv": _reference_chambolle,
    "he_clip": _reference_he_clip,
    "he_cdf": lambda image: np.asarray(exposure.equalize_hist(image, nbins=65536)),
    "clahe": lambda image: np.asarray(exposure.equalize_adapthist(image, kernel_size=(image.shape[0] // 8, image.shape[1] // 8), clip_limit=0.01)),
    "median": lambda image: np.asarray(ndimage.median_filter(image, 3)),
    "band_pass": _reference_band_pass,
    "bilateral": lambda image: np.asarray(restoration.denoise_bilateral(image, win_size=5, sigma_color=35 / 255, sigma_spatial=35)),
    "difference_of_gaussians": _reference_gaussians,
    "stretch": lambda image: np.asarray(exposure.rescale_intensity(image, in_range=tuple(np.percentile(image, (1, 99))), out_range=np.uint8)),
}
