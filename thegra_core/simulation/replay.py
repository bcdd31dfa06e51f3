"""Images of an existing recording as temperatures, so that the simulated sensor can look at them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thegra_core.errors import InputError
from thegra_core.geometry.camera import CameraModel
from thegra_core.geometry.poses import interpolate
from thegra_core.outputs.trajectory import Trajectory, read_tum
from thegra_core.simulation.sensor_config import SensorConfig
from thegra_core.sources.open import open_recording
from thegra_core.sources.recording import Recording

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_COUNTS_PER_KELVIN = {8: 25.0, 16: 40.0}
_LONGEST_STEP_NS = 500_000_000  # ground truth farther apart is not interpolated


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """A recording read as temperatures: the median of its first image is the sensor's reference temperature. stamps_ns (N,), strictly increasing."""

    name: str
    image_size: tuple[int, int]
    camera: CameraModel | None
    stamps_ns: IntArray
    _recording: Recording
    _indices: frozenset[int]
    _counts_per_kelvin: float
    _middle: float
    _reference_k: float
    _truth: Trajectory | None

    def kelvin(self) -> Iterator[FloatArray]:
        """Apparent temperature (H, W) K of each frame."""
        for frame in self._recording.frames():
            if frame.index in self._indices:
                yield self._reference_k + (frame.image.astype(np.float64) - self._middle) / self._counts_per_kelvin

    def pose_at(self, stamp_ns: int) -> FloatArray | None:
        """The source's ground truth at a stamp, interpolated; None where it has none."""
        if self._truth is None:
            return None
        stamps, poses = self._truth.stamps_ns, self._truth.poses
        after = int(np.searchsorted(stamps, stamp_ns))
        if after < len(stamps) and stamps[after] == stamp_ns:
            return np.asarray(poses[after])
        if after in (0, len(stamps)) or stamps[after] - stamps[after - 1] > _LONGEST_STEP_NS:
            return None
        return interpolate(poses[after - 1], poses[after], float((stamp_ns - stamps[after - 1]) / (stamps[after] - stamps[after - 1])))


def replay(source: Path, config: SensorConfig, counts_per_kelvin: float | None = None) -> Replay:
    """Open a recording; frames of another size than the first, or whose stamp is not after the one before, are left out.

    Raises:
        InputError: If it holds no readable image.
    """
    recording = open_recording(source)
    stamps: list[int] = []
    indices: list[int] = []
    first = None
    for frame in recording.frames():
        first = frame.image if first is None else first
        if frame.image.shape == first.shape and (not stamps or frame.stamp_ns > stamps[-1]):
            stamps.append(frame.stamp_ns)
            indices.append(frame.index)
    if first is None:
        raise InputError(f"no readable image in {source}\nlook at it with: thegra info {source}")
    truth = read_tum(recording.groundtruth) if recording.groundtruth is not None else None
    return Replay(
        name=recording.name, image_size=(first.shape[1], first.shape[0]), camera=recording.camera, stamps_ns=np.array(stamps, np.int64), _recording=recording,
        _indices=frozenset(indices), _counts_per_kelvin=counts_per_kelvin or _COUNTS_PER_KELVIN[8 if first.dtype == np.uint8 else 16],
        _middle=float(np.median(first)), _reference_k=config.reference_k, _truth=truth,
    )  # fmt: skip
