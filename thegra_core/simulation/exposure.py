"""What a bolometer sees while the camera moves: each pixel follows the scene with a lag, and rows may be read out one after the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry.poses import inverse
from thegra_core.simulation.paths import HandHeldPath
from thegra_core.simulation.renderer import Renderer
from thegra_core.simulation.sensor_config import SensorConfig

FloatArray = NDArray[np.float64]

_STILL_PX, _FAST_PX = 0.7, 4.0
_EXPOSURES, _FAST_EXPOSURES = 4, 8
_MOVING_SHARE = 75  # percentile of the image's motion that counts
_PROBES = 7


class Exposure:
    """Renders images of a moving camera through its bolometers' lag.

    A bolometer's temperature is the scene's, weighted by exp(-age / time constant). That is the mean over exposures at the quantiles of the exponential
    distribution; as many as the image moves fast. Their mean age is taken off: stamp and pose are those of the middle of what the image shows, as if
    the camera's driver knew its lag.
    """

    def __init__(self, renderer: Renderer, path: HandHeldPath, config: SensorConfig) -> None:
        self._renderer, self._path = renderer, path
        self._lag_s = 1e-3 * config.time_constant_ms
        height = renderer.camera.image_size[1]
        self._row_s = 1e-6 * config.row_time_us * (np.arange(height) - (height - 1) / 2)
        self._rolling = config.row_time_us > 0

    def at(self, t_s: float) -> FloatArray:
        """Apparent temperature (H, W) K of the image whose middle is at `t_s`."""
        count = self.count(t_s)
        if count == 1:
            return self._renderer.render(self._poses(t_s)).kelvin
        kelvin = [self._renderer.render_part(self._poses(t_s - age), part) for part, age in enumerate(exposure_ages(count, self._lag_s))]
        return np.asarray(np.mean(kelvin, axis=0))

    def count(self, t_s: float) -> int:
        """How many exposures the motion at `t_s` asks for."""
        moved = self.motion_px(t_s)
        return 1 if moved < _STILL_PX else _EXPOSURES if moved < _FAST_PX else _FAST_EXPOSURES

    def motion_px(self, t_s: float) -> float:
        """How far the image moves in one time constant, px: of the pixels of a grid, three quarters move less."""
        camera = self._renderer.camera
        width, height = camera.image_size
        x, y = (np.linspace(0.1 * size, 0.9 * size, _PROBES).astype(int) for size in (width, height))
        pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        before, after = self._path.poses([t_s - self._lag_s / 2, t_s + self._lag_s / 2])
        rays = np.concatenate([camera.undistort(pixels.astype(np.float64)), np.ones((len(pixels), 1))], axis=1)
        points = rays * self._renderer.depth_along(rays, self._path.pose(t_s))[:, None]
        relative = inverse(after) @ before
        moved = camera.project(points @ relative[:3, :3].T + relative[:3, 3]) - pixels
        return float(np.nanpercentile(np.linalg.norm(moved, axis=1), _MOVING_SHARE))

    def _poses(self, t_s: float) -> FloatArray:
        return self._path.poses(t_s + self._row_s) if self._rolling else self._path.pose(t_s)


def exposure_ages(count: int, lag_s: float) -> FloatArray:
    """Ages (count,) s before the middle: quantiles of the exponential distribution of mean `lag_s`, less their mean."""
    ages = -lag_s * np.log1p(-(np.arange(count) + 0.5) / count)
    return np.asarray(ages - ages.mean())
