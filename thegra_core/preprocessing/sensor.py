"""What the raw image tells of the sensor rather than of the scene: its level and its fixed pattern, which a flat-field shutter sets anew."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thegra_core.messages import ImageArray
from thegra_core.preprocessing.noise import EVERY, FINE_GAIN, clipped, noise_of, sampled_rows, second_difference

FloatImage = NDArray[np.float32]

_MEMORY = 32
_KNOWN_AFTER = 8
"""Frames before a usual value is known."""
_PATTERN_FRAMES = 16
"""Frames that the pattern is the mean of."""
_KNOWN_PATTERN = 10.0
"""Standard errors of its strength by which a pattern must show to be followed."""
_SAME, _SURE = 0.25, 0.5
"""Shares of the usual strength: below the first the pattern is another one, if three standard errors more do not reach the second."""
_MOVING = 1.2
"""Spread of a difference of frames over its noise, from which the camera moves."""
_LEVEL_SPREADS = 4.0
_LEVEL_USUAL = 8.0
_FLAT_SHARE = 0.25
_FLAT_NOISE = 6.0
"""Spread (5 to 95 %) of an image over its noise; noise alone has 3.3."""


@dataclass(frozen=True, slots=True)
class SensorLook:
    """Some rows of an image: values (R, W), their clipped second differences (R, W - 2), the noise and the spread (5 to 95 %) of the values.

    gain_is_automatic: 8-bit video, whose level follows the scene by itself.
    """

    values: FloatImage
    fine: FloatImage
    noise: float
    spread: float
    gain_is_automatic: bool

    @classmethod
    def at(cls, image: ImageArray) -> SensorLook:
        """The look at an image (H, W) of any type."""
        values = sampled_rows(image)
        fine = clipped(second_difference(values))
        low, high = np.percentile(values[:, ::EVERY], [5, 95])
        return cls(values, fine, noise_of(fine), float(high - low), image.dtype == np.uint8)


class SensorWatch:
    """Follows the sensor through a stream of open frames, in about half a millisecond each.

    The fixed pattern is what remains of many images' finest detail when the camera moves: the mean of their horizontal second differences, each
    clipped so that edges count little. Every image holds it in about the same strength until the shutter, which measures the pattern anew, changes it
    from one frame to the next; a scene, however new, leaves the strength. Frames between which nothing moves teach nothing: their detail is the scene's.
    """

    def __init__(self) -> None:
        self._last: SensorLook | None = None
        self._pattern: FloatImage | None = None
        self._learned = 0
        self._strengths: deque[float] = deque(maxlen=_KNOWN_AFTER)
        self._steps: deque[float] = deque(maxlen=_MEMORY)
        self._spreads: deque[float] = deque(maxlen=_KNOWN_AFTER)

    def is_flat(self, look: SensorLook) -> bool:
        """Whether the image suddenly shows nothing but noise: the shutter's blade."""
        if len(self._spreads) < _KNOWN_AFTER:
            return False
        return look.spread < _FLAT_SHARE * float(np.median(self._spreads)) and look.spread < _FLAT_NOISE * look.noise

    def update(self, look: SensorLook) -> str:
        """Take an open frame; what has changed about the sensor since the last one, or an empty string. After a change all is learned anew."""
        last = self._last
        change = ""
        if last is not None and last.values.shape == look.values.shape:
            difference = look.values - last.values
            change = self._level_change(look, last, difference[:, ::EVERY]) or self._pattern_change(look, difference)
        if change or (last is not None and last.values.shape != look.values.shape):
            self.forget()
        self._last = look
        self._spreads.append(look.spread)
        return change

    def forget(self) -> None:
        """Begin anew: after a closure."""
        self._last = self._pattern = None
        self._learned = 0
        for kept in (self._strengths, self._steps, self._spreads):
            kept.clear()

    def _level_change(self, look: SensorLook, last: SensorLook, difference: FloatImage) -> str:
        """Whether all pixels jumped by the same amount."""
        middle = float(np.median(difference))
        spread = max(1.4826 * float(np.median(np.abs(difference - middle))), last.noise)
        step = abs(float(np.clip(difference, middle - 2 * spread, middle + 2 * spread).mean()))
        usual = float(np.percentile(self._steps, 90)) if len(self._steps) >= _KNOWN_AFTER else np.inf
        self._steps.append(step)
        if look.gain_is_automatic or step < _LEVEL_SPREADS * spread or step < _LEVEL_USUAL * usual:
            return ""
        return f"the level of the whole image jumped by {step:.3g}"

    def _pattern_change(self, look: SensorLook, difference: FloatImage) -> str:
        strength = 0.0
        if self._pattern is not None:
            size = max(float(np.linalg.norm(self._pattern)), 1e-12)
            strength = float(np.vdot(look.fine, self._pattern)) / size**2
            error = float(np.linalg.norm(look.fine)) / look.fine.size**0.5 / size
            usual = float(np.median(self._strengths)) if len(self._strengths) == _KNOWN_AFTER else 0.0
            if usual > _KNOWN_PATTERN * error and strength < _SAME * usual and strength + 3 * error < _SURE * usual:
                return f"the fixed pattern changed: {100 * max(strength, 0.0) / usual:.0f} % of it are left"
        if _moving(difference):
            self._learned += 1
            share = np.float32(1.0 / min(self._learned, _PATTERN_FRAMES))
            self._pattern = look.fine if self._pattern is None else self._pattern + share * (look.fine - self._pattern)
            if self._learned > _KNOWN_AFTER:
                self._strengths.append(strength)
        return ""


def _moving(difference: FloatImage) -> bool:
    """Whether the difference of two images has more than noise in it, which is the same at all scales."""
    noise = float(np.mean(np.abs(second_difference(difference)[:, ::EVERY]))) / FINE_GAIN
    coarse = difference[:, ::EVERY]
    return float(np.mean(np.abs(coarse - coarse.mean()))) > _MOVING * noise
