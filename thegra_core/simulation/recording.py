"""What a simulated recording consists of, whatever the format it is written in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry.camera import CameraModel

FloatArray = NDArray[np.float64]
ImageArray = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True, slots=True, eq=False)
class Tick:
    """One frame's time: its stamp, its image (None: lost, or in a gap), and the true `world_from_camera` at its stamp (None: unknown)."""

    stamp_ns: int
    image: ImageArray | None
    world_from_camera: FloatArray | None


@dataclass(frozen=True, slots=True, eq=False)
class Simulated:
    """A recording in the making: ticks may be iterated once.

    name: scene, or the source's name. style: as in the paper. closures_ns: (begin, end) stamps of the first blind and the first seen frame.
    """

    name: str
    style: str
    outdoors: bool
    camera: CameraModel | None
    closures_ns: tuple[tuple[int, int], ...]
    count: int
    ticks: Iterator[Tick]
