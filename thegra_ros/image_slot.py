"""One image in memory that two processes share: a pipe would carry it in a dozen pieces, and wake both ends for each."""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass, replace
from multiprocessing.context import SpawnContext
from typing import Any

import numpy as np

from thegra_core.messages import Frame

MOST_BYTES = 16 << 20
"""A larger image goes through the pipe. Memory that is never written to costs nothing."""


@dataclass(frozen=True, slots=True)
class InSlot:
    """A frame whose image is in the slot."""

    frame: Frame
    shape: tuple[int, ...]
    dtype: str


def make_slot(context: SpawnContext) -> Any:
    """The memory; hand it to the other process when that is made."""
    return context.RawArray(ctypes.c_ubyte, MOST_BYTES)


def put(slot: Any, frame: Frame) -> InSlot | Frame:
    """Leave a frame's image in the slot; it stays until the next one is put. What has no room is returned as it is."""
    if frame.image.nbytes > MOST_BYTES:
        return frame
    _view(slot, frame.image.shape, frame.image.dtype.str)[...] = frame.image
    return InSlot(replace(frame, image=np.empty((0, 0), np.uint8)), frame.image.shape, frame.image.dtype.str)


def take(slot: Any, left: InSlot | Frame) -> Frame:
    """The frame with its image, a copy."""
    return left if isinstance(left, Frame) else replace(left.frame, image=_view(slot, left.shape, left.dtype).copy())


def _view(slot: Any, shape: tuple[int, ...], dtype: str) -> np.ndarray[Any, Any]:
    return np.frombuffer(slot, dtype=dtype, count=math.prod(shape)).reshape(shape)
