"""The pre-processing stage: frames in; the shutter's state and images of 8 bit out. It knows nothing of what is made of them, so that it may run ahead."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import PreprocessingConfig
from thegra_core.messages import Frame, Shutter, ShutterState
from thegra_core.preprocessing.chain import Chain
from thegra_core.preprocessing.shutter import ShutterDetector

BACKWARD_FRAMES = 3
"""Backward stamps in a row that are refused before time is believed to have been set back."""


@dataclass(frozen=True, slots=True)
class Prepared:
    """A frame as the front end takes it.

    trouble: What is wrong with the frame, or an empty string; such a frame counts for nothing, and has neither `shutter` nor `image`.
    image: (H, W) uint8; None while the shutter is closed. stage_ms: What the steps took.
    """

    frame: Frame
    trouble: str = ""
    shutter: ShutterState | None = None
    image: NDArray[np.uint8] | None = None
    stage_ms: Mapping[str, float] = field(default_factory=dict)


class PreprocessingStage:
    """State of pre-processing: the stream's stamps, its shutter and the windows of its grey levels. One caller at a time, in the order of the stream.

    Args:
        image_size: (width, height) that images must have; None where that is not known.

    Raises:
        ConfigError: See `Chain`.
    """

    def __init__(self, config: PreprocessingConfig, image_size: tuple[int, int] | None = None) -> None:
        self._config = config
        self._chain = Chain(config)
        self._shutter = ShutterDetector(config.shutter)
        self._image_size = image_size
        self._last_stamp_ns: int | None = None
        self._backward, self._backward_ns = 0, None  # type: int, int | None

    def warm_up(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The filters' result for an image that is not of the stream: what is compiled at its first use has been compiled then."""
        result = self._chain(image, 0)
        self._chain.reset()
        return result

    def process(self, frame: Frame) -> Prepared:
        """Look for the shutter, and filter what the camera sees; never raises for what an image holds.

        Raises:
            ConfigError: See `Chain`.
        """
        trouble = self._trouble(frame)
        if trouble:
            return Prepared(frame, trouble)
        if self._last_stamp_ns is not None and frame.stamp_ns < self._last_stamp_ns:  # another time: nothing before it can be compared with
            self._shutter = ShutterDetector(self._config.shutter)
            self._chain.reset()
        self._last_stamp_ns, self._backward = frame.stamp_ns, 0
        begin = time.perf_counter()
        state = self._shutter.update(frame)
        seen = time.perf_counter()
        if state.recalibrated:
            self._chain.reset()
        if state.shutter is Shutter.CLOSED:
            return Prepared(frame, shutter=state, stage_ms={"shutter": 1e3 * (seen - begin)})
        image = self._chain(frame.image, frame.stamp_ns)
        return Prepared(frame, "", state, image, {"shutter": 1e3 * (seen - begin), "preprocessing": 1e3 * (time.perf_counter() - seen)})

    def _trouble(self, frame: Frame) -> str:
        if frame.image.ndim != 2 or self._image_size not in (None, frame.image.shape[::-1]):
            return "image size differs from the camera's"
        if frame.image.dtype.kind == "f" and not np.all(np.isfinite(frame.image)):
            return "image holds NaN or infinity"
        if self._last_stamp_ns is not None and frame.stamp_ns == self._last_stamp_ns:
            return "stamp repeats"
        if self._last_stamp_ns is not None and frame.stamp_ns < self._last_stamp_ns and not self._new_epoch(frame.stamp_ns):
            return "stamp goes backwards"
        return ""

    def _new_epoch(self, stamp_ns: int) -> bool:
        """Whether enough backward stamps in a row ascend among themselves: then the clock was set, or one stamp was wrong, and time goes on from here."""
        self._backward = self._backward + 1 if self._backward_ns is not None and stamp_ns > self._backward_ns else 1
        self._backward_ns = stamp_ns
        return self._backward > BACKWARD_FRAMES
