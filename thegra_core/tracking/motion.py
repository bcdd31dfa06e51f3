"""Constant-velocity motion, in frame periods so that 30 Hz video and photo flights behave alike."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thegra_core.geometry import poses
from thegra_core.geometry.similarity import Similarity

FloatArray = NDArray[np.float64]


class MotionModel:
    """Remembers the last two poses and extrapolates them."""

    def __init__(self) -> None:
        self._previous: tuple[int, FloatArray] | None = None
        self._last: tuple[int, FloatArray] | None = None
        self._covariance: FloatArray | None = None

    def update(self, stamp_ns: int, world_from_camera: FloatArray, covariance: FloatArray | None = None) -> None:
        """Add an estimated pose (4, 4) and its covariance (6, 6), rotation first, in the camera frame; stamps must ascend."""
        self._previous, self._last = self._last, (stamp_ns, world_from_camera)
        self._covariance = covariance

    def reset(self) -> None:
        """Forget all poses."""
        self._previous = self._last = self._covariance = None

    def move(self, new_from_old: Similarity) -> None:
        """The world was corrected, or became part of another: carry the remembered poses along."""
        if self._previous is not None:
            self._previous = (self._previous[0], (new_from_old @ Similarity(self._previous[1])).rigid)
        if self._last is not None:
            self._last = (self._last[0], (new_from_old @ Similarity(self._last[1])).rigid)

    def predict(self, stamp_ns: int) -> FloatArray | None:
        """world_from_camera (4, 4) at a stamp at the last velocity; the last pose if there is no velocity; None without any pose."""
        if self._last is None:
            return None
        if self._previous is None or self._last[0] <= self._previous[0]:
            return self._last[1]
        fraction = (stamp_ns - self._previous[0]) / (self._last[0] - self._previous[0])
        return poses.interpolate(self._previous[1], self._last[1], fraction)

    def predicted_covariance(self, stamp_ns: int) -> FloatArray | None:
        """Covariance (6, 6) of `predict`: that of the last pose, carried along, and a standard deviation of all the motion since, for the camera may have
        stopped. None without a last covariance or a velocity."""
        twist, predicted = self.twist(), self.predict(stamp_ns)
        if self._last is None or self._covariance is None or twist is None or predicted is None:
            return None
        carried = poses.adjoint(poses.inverse(predicted) @ self._last[1])
        motion = (stamp_ns - self._last[0]) / 1e9 * twist
        deviation = np.repeat([np.linalg.norm(motion[:3]), np.linalg.norm(motion[3:])], 3)
        return np.asarray(carried @ self._covariance @ carried.T + np.diag(deviation**2))

    def since(self, stamp_ns: int) -> float:
        """Seconds from the last pose to a stamp; infinite without one."""
        return np.inf if self._last is None else (stamp_ns - self._last[0]) / 1e9

    def twist(self) -> FloatArray | None:
        """Angular (rad/s) and linear (map units/s) velocity (6,) in the camera frame between the last two poses."""
        if self._last is None or self._previous is None or self._last[0] <= self._previous[0]:
            return None
        seconds = (self._last[0] - self._previous[0]) / 1e9
        relative = poses.inverse(self._previous[1]) @ self._last[1]
        return np.concatenate([poses.so3_log(relative[:3, :3]), relative[:3, 3]]) / seconds
