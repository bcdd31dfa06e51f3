"""The configured filters as one function from a raw image to the 8-bit image that the network sees."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import PreprocessingConfig, Section
from thegra_core.errors import ConfigError
from thegra_core.messages import ImageArray
from thegra_core.preprocessing import filters

FILTERS: dict[str, Callable[..., ImageArray]] = {
    "chambolle_tv": filters.chambolle_tv,
    "he_clip": filters.he_clip,
    "he_cdf": filters.he_cdf,
    "clahe": filters.clahe,
    "median": filters.median,
    "band_pass": filters.band_pass,
    "bilateral": filters.bilateral,
    "stretch": filters.stretch,
}
TO_8_BIT = ("he_clip", "he_cdf", "stretch")
"""Filters that give 8 bit whatever they get."""

Chain = Callable[[ImageArray], NDArray[np.uint8]]


def build_chain(config: PreprocessingConfig) -> Chain:
    """The filters of `config`, in order, as one function (H, W) uint8 | uint16 | float32 -> (H, W) uint8.

    Raises:
        ConfigError: If a filter is unknown, or no input could come out as 8 bit. The function itself raises it when this input did not.
    """
    steps = [_step(section) for section in config.filters]
    description = " -> ".join(str(getattr(section, "filter", section)) for section in config.filters) or "(no filters)"

    def run(image: ImageArray) -> NDArray[np.uint8]:
        result = image
        for step in steps:
            result = step(result)
        if result.dtype != np.uint8:
            raise ConfigError(
                f"the preprocessing chain {description} gives {result.dtype} from a {image.dtype} image, the networks need 8 bit: "
                f"add one of {', '.join(TO_8_BIT)} to preprocessing.filters"
            )
        return np.asarray(result, dtype=np.uint8)

    run(np.zeros((32, 32), np.uint8))  # a chain that cannot turn even 8 bit into 8 bit is wrong for every camera
    return run


def _step(section: Section) -> Callable[[ImageArray], ImageArray]:
    parameters: dict[str, Any] = section.model_dump()
    name = parameters.pop("filter", type(section).__name__)
    if name not in FILTERS:
        raise ConfigError(f"unknown filter {name!r} in preprocessing.filters; known: {', '.join(FILTERS)}")
    function = FILTERS[name]
    return lambda image: function(image, **parameters)
