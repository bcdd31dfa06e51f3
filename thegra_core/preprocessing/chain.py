"""The configured filters, in order, from a raw image to the 8-bit image that the network sees."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import PreprocessingConfig, Section
from thegra_core.errors import ConfigError
from thegra_core.messages import ImageArray
from thegra_core.preprocessing import filters, repair, windows
from thegra_core.preprocessing.stability import SteadyWindow

FILTERS: dict[str, Callable[..., ImageArray]] = {
    "chambolle_tv": filters.chambolle_tv,
    "he_clip": windows.he_clip,
    "he_cdf": filters.he_cdf,
    "clahe": filters.clahe,
    "median": filters.median,
    "band_pass": filters.band_pass,
    "bilateral": filters.bilateral,
    "difference_of_gaussians": filters.difference_of_gaussians,
    "stretch": windows.stretch,
    "kelvin_window": windows.kelvin_window,
    "destripe": repair.destripe,
    "svd_destripe": repair.svd_destripe,
    "repair_dead_pixels": repair.repair_dead_pixels,
}
LIMITS: dict[str, Callable[..., tuple[float, float]]] = {"he_clip": windows.tail_limits, "stretch": windows.percentile_limits}
"""Filters that map a window of the frame's own: its limits can be carried along a stream."""
TO_8_BIT = ("he_clip", "he_cdf", "stretch", "kelvin_window")
"""Filters that give 8 bit whatever they get."""


class Chain:
    """Filters in order. Without a steady window a pure function of the image; with one, frames must come in the stream's order.

    Raises:
        ConfigError: If a filter is unknown, or no input could come out as 8 bit. A call raises it when this input did not.
    """

    def __init__(self, config: PreprocessingConfig) -> None:
        self._windows: list[SteadyWindow] = []
        self._steps = [self._step(section, config.window_s) for section in config.filters]
        self._description = " -> ".join(str(getattr(section, "filter", section)) for section in config.filters) or "(no filters)"
        self(np.zeros((32, 32), np.uint8), 0)  # a chain that cannot turn even 8 bit into 8 bit is wrong for every camera
        self.reset()

    def __call__(self, image: ImageArray, stamp_ns: int) -> NDArray[np.uint8]:
        """(H, W) uint8, uint16 or float32, of any byte order and strides, to (H, W) uint8."""
        result = cast(ImageArray, np.ascontiguousarray(image, dtype=image.dtype.newbyteorder("=")))
        for step in self._steps:
            result = step(result, stamp_ns)
        if result.dtype != np.uint8:
            raise ConfigError(
                f"the preprocessing chain {self._description} gives {result.dtype} from a {image.dtype} image, the networks need 8 bit: "
                f"add one of {', '.join(TO_8_BIT)} to preprocessing.filters"
            )
        return np.asarray(result, dtype=np.uint8)

    def reset(self) -> None:
        """Forget the stream: the next frame has a window of its own."""
        for window in self._windows:
            window.reset()

    def _step(self, section: Section, window_s: float) -> Callable[[ImageArray, int], ImageArray]:
        parameters: dict[str, Any] = section.model_dump()
        name = parameters.pop("filter", type(section).__name__)
        if name not in FILTERS:
            raise ConfigError(f"unknown filter {name!r} in preprocessing.filters; known: {', '.join(FILTERS)}")
        function, limits_of = FILTERS[name], LIMITS.get(name)
        if limits_of is None or window_s == 0:
            return lambda image, _stamp_ns: function(image, **parameters)
        fold, steady = bool(parameters.pop("fold", False)), SteadyWindow(window_s)
        self._windows.append(steady)
        return lambda image, stamp_ns: windows.map_window(image, steady.update(limits_of(image, **parameters), stamp_ns), fold)
