"""A thermal camera's sensor: apparent temperature in, counts out, with what changes in it over time.

It knows nothing of scenes: any sequence of temperature images in the order of time will do.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thegra_core.simulation.sensor_config import SensorConfig
from thegra_core.simulation.sensor_terms import (
    blur,
    correlated_step,
    digitize,
    dome,
    linear_gain,
    linear_limits,
    plateau_curve,
    stuck_pixels,
)

FloatArray = NDArray[np.float64]
ImageArray = NDArray[np.uint8] | NDArray[np.uint16]

_MINUTE_S = 60.0


class Sensor:
    """The state of one sensor: its level, its fixed pattern, its dead pixels, its gain.

    `image_size` is (width, height). The same configuration, seed, images and times give the same counts.
    """

    def __init__(self, config: SensorConfig, image_size: tuple[int, int], seed: int = 0) -> None:
        self._config = config
        self._shape = (image_size[1], image_size[0])
        made, self._noise, self._drift, self._corrections = (np.random.default_rng([seed, purpose]) for purpose in range(4))
        self._dome = dome(self._shape)
        self._dead, self._stuck = stuck_pixels(self._shape, config.dead_pixels, config.bits, made)
        self._time_s: float | None = None
        self._corrected_s = 0.0
        self._offset_k = 0.0
        self._left_over = self._random_pattern(self._corrections)
        self._growing = self._random_pattern(self._drift)
        self._limits: tuple[float, float] | None = None
        self._curve: FloatArray | None = None

    @property
    def offset_k(self) -> float:
        """Level of the whole image now, K."""
        return self._offset_k

    def pattern_k(self) -> FloatArray:
        """Fixed pattern now, (H, W) K: single pixels and columns."""
        c = self._config
        grown = c.pattern_growth * self._since_correction_s() / _MINUTE_S
        pixels = c.pattern_netd * self._left_over[0] + grown * self._growing[0]
        # columns grow in proportion to what they start with
        ratio = c.column_netd / c.pattern_netd if c.pattern_netd > 0 else 1.0
        columns = c.column_netd * self._left_over[1] + grown * ratio * self._growing[1]
        return np.asarray(1e-3 * c.netd_mk * (pixels + columns))

    def expose(self, kelvin: FloatArray, t_s: float) -> ImageArray:
        """Image (H, W) of apparent temperatures (H, W) K at a time; uint16 counts, or uint8 with automatic gain.

        Raises:
            ValueError: If time goes back or the image has another size.
        """
        if kelvin.shape != self._shape:
            raise ValueError(f"the sensor has {self._shape[1]}x{self._shape[0]} pixels, the image {kelvin.shape[1]}x{kelvin.shape[0]}")
        dt_s = self._advance(t_s)
        c = self._config
        seen = blur(kelvin, c.optics_blur_px) + self._offset_k + self.pattern_k() + c.dome_k_per_min * self._since_correction_s() / _MINUTE_S * self._dome
        seen += 1e-3 * c.netd_mk * self._noise.standard_normal(self._shape)
        counts = digitize(seen, c.counts_per_kelvin, c.reference_k, c.reference_counts, c.bits)
        counts.reshape(-1)[self._dead] = self._stuck
        return counts if c.agc == "off" else self._gain(counts, dt_s)

    def correct(self, t_s: float) -> None:
        """A flat-field correction ends at this time: another pattern is left over, the level jumps."""
        self._advance(t_s)
        self._corrected_s = t_s
        self._left_over = self._random_pattern(self._corrections)
        self._offset_k += self._config.offset_jump_k * float(self._corrections.standard_normal())

    def _since_correction_s(self) -> float:
        return (self._time_s or 0.0) - self._corrected_s

    def _advance(self, t_s: float) -> float:
        if self._time_s is None:
            self._time_s = self._corrected_s = t_s
        dt_s = t_s - self._time_s
        if dt_s < 0:
            raise ValueError(f"time goes back from {self._time_s} to {t_s} s")
        c = self._config
        self._offset_k += c.offset_drift_k * np.sqrt(dt_s / _MINUTE_S) * float(self._drift.standard_normal())
        self._growing = (correlated_step(self._growing[0], dt_s, c.pattern_time_s, self._drift), correlated_step(self._growing[1], dt_s, c.pattern_time_s, self._drift))
        self._time_s = t_s
        return dt_s

    def _random_pattern(self, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Unit noise for the pixels (H, W) and the columns (W,)."""
        return rng.standard_normal(self._shape), rng.standard_normal(self._shape[1])

    def _gain(self, counts: NDArray[np.uint16], dt_s: float) -> NDArray[np.uint8]:
        c = self._config
        keep = float(np.exp(-dt_s / c.agc_time_s)) if c.agc_time_s > 0 else 0.0
        if c.agc == "linear":
            now = linear_limits(counts, c.agc_tail)
            before = self._limits or now
            self._limits = (keep * before[0] + (1 - keep) * now[0], keep * before[1] + (1 - keep) * now[1])
            return linear_gain(counts, self._limits)
        curve = plateau_curve(counts, c.agc_plateau, c.bits)
        self._curve = curve if self._curve is None else keep * self._curve + (1 - keep) * curve
        return np.rint(self._curve[counts]).astype(np.uint8)
