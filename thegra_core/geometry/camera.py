"""Camera models: pixels of the raw image to undistorted coordinates and back.

plumb_bob and rational_polynomial follow OpenCV's pinhole model, equidistant its fisheye (Kannala-Brandt 2006) model.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, unique
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from thegra_core.errors import CalibrationError

FloatArray = NDArray[np.float64]


@unique
class DistortionModel(Enum):
    """Names as in sensor_msgs/CameraInfo."""

    PLUMB_BOB = "plumb_bob"
    RATIONAL_POLYNOMIAL = "rational_polynomial"
    EQUIDISTANT = "equidistant"


_COEFFICIENTS = {DistortionModel.PLUMB_BOB: 5, DistortionModel.RATIONAL_POLYNOMIAL: 8, DistortionModel.EQUIDISTANT: 4}
_MAX_ITERATIONS = 100
_CONVERGED = 1e-12


@dataclass(frozen=True, eq=False)
class CameraModel:
    """Intrinsics of one camera.

    matrix (3, 3) float64 px; distortion (5,) k1 k2 p1 p2 k3, (8,) with k4 k5 k6, or (4,) k1..k4 of the fisheye polynomial;
    image_size (width, height) px.

    Raises:
        CalibrationError: If the focal lengths are not positive and finite, a coefficient is no number, or there are too many for the model.
    """

    matrix: FloatArray
    distortion: FloatArray
    model: DistortionModel
    image_size: tuple[int, int]
    name: str = ""

    def __post_init__(self) -> None:
        matrix = np.asarray(self.matrix, dtype=np.float64).reshape(3, 3)
        wanted = _COEFFICIENTS[self.model]
        given = np.asarray(self.distortion, dtype=np.float64).ravel()
        if len(given) > wanted and not np.any(given[wanted:]):
            given = given[:wanted]
        if len(given) > wanted:
            raise CalibrationError(f"{self.model.value} takes at most {wanted} distortion coefficients, got {len(given)}: check distortion_model in the camera file")
        if not np.all(np.isfinite(matrix)) or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
            raise CalibrationError(f"the camera matrix has fx = {matrix[0, 0]:g}, fy = {matrix[1, 1]:g}; both must be positive: give a calibration with --camera FILE")
        if not np.all(np.isfinite(given)):
            raise CalibrationError(f"the distortion coefficients {given.tolist()} are not all numbers: check them in the camera file")
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "distortion", np.pad(given, (0, wanted - len(given))))

    def same_as(self, other: CameraModel) -> bool:
        """Whether the numbers are the same, whatever the name."""
        return (
            self.model is other.model
            and self.image_size == other.image_size
            and np.array_equal(self.matrix, other.matrix)
            and np.array_equal(self.distortion, other.distortion)
        )

    @property
    def focal(self) -> float:
        """Mean focal length (px)."""
        return float(np.sqrt(self.matrix[0, 0] * self.matrix[1, 1]))

    @cached_property
    def max_radius(self) -> float:
        """Largest distance from the axis, on the plane z = 1, of any pixel on the image's edge."""
        width, height = self.image_size
        x, y = np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 33)
        edge = np.concatenate([np.stack([x, np.full(33, v)], axis=1) for v in (0, height - 1)] + [np.stack([np.full(33, v), y], axis=1) for v in (0, width - 1)])
        return float(np.nanmax(np.linalg.norm(self.undistort(edge), axis=1)))

    @cached_property
    def _lens(self) -> FloatArray:
        return np.pad(self.distortion, (0, 8 - len(self.distortion)))

    def project(self, points_camera: FloatArray) -> FloatArray:
        """Project points (N, 3) in the camera frame to raw pixels (N, 2); NaN where z <= 0."""
        points = np.asarray(points_camera, dtype=np.float64).reshape(-1, 3)
        z = points[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            normalized = np.where(z[:, None] > 0, points[:, :2] / z[:, None], np.nan)
            return self.distort(normalized)

    def distort(self, normalized: FloatArray) -> FloatArray:
        """Undistorted coordinates (N, 2) on the plane z = 1 to raw pixels (N, 2)."""
        distorted = self._distort_normalized(np.asarray(normalized, dtype=np.float64).reshape(-1, 2))
        k = self.matrix
        x = k[0, 0] * distorted[:, 0] + k[0, 1] * distorted[:, 1] + k[0, 2]
        return np.stack([x, k[1, 1] * distorted[:, 1] + k[1, 2]], axis=1)

    def undistort(self, pixels: FloatArray) -> FloatArray:
        """Raw pixels (N, 2) to undistorted coordinates (N, 2) on the plane z = 1, NaN where the model cannot be inverted.

        Newton's method on the distortion until a step is below 1e-12; pixels beyond the radius where the model stops
        growing do not converge and give NaN.
        """
        pixels = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        k = self.matrix
        y = (pixels[:, 1] - k[1, 2]) / k[1, 1]
        x = (pixels[:, 0] - k[0, 2] - k[0, 1] * y) / k[0, 0]
        target = np.stack([x, y], axis=1)
        if self.model is DistortionModel.EQUIDISTANT:  # bends rays even where all its coefficients are zero
            return self._undistort_fisheye(target)
        if not np.any(self.distortion):
            return target
        from thegra_core.geometry import lens  # compiled: only who has pixels waits for the compiler

        return lens.undistort(self._lens, target)

    def bearings(self, pixels: FloatArray) -> FloatArray:
        """Unit rays (N, 3) in the camera frame through raw pixels (N, 2)."""
        normalized = self.undistort(pixels)
        rays = np.concatenate([normalized, np.ones((len(normalized), 1))], axis=1)
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def contains(self, pixels: FloatArray, border: float = 0.0) -> NDArray[np.bool_]:
        """(N,) whether raw pixels (N, 2) lie in the image, `border` px inside its edge."""
        width, height = self.image_size
        with np.errstate(invalid="ignore"):
            x, y = pixels[:, 0], pixels[:, 1]
            return np.asarray((x >= border) & (x <= width - 1 - border) & (y >= border) & (y <= height - 1 - border))

    def _distort_normalized(self, p: FloatArray) -> FloatArray:
        d = self.distortion
        r2 = np.einsum("ni,ni->n", p, p)
        if self.model is DistortionModel.EQUIDISTANT:
            r = np.sqrt(r2)
            theta = np.arctan(r)
            t2 = theta * theta
            theta_d = theta * (1 + t2 * (d[0] + t2 * (d[1] + t2 * (d[2] + t2 * d[3]))))
            scale = np.divide(theta_d, r, out=np.ones_like(r), where=r > 1e-12)
            return np.asarray(p * scale[:, None])
        from thegra_core.geometry import lens

        return lens.distort(self._lens, np.ascontiguousarray(p))

    def _undistort_fisheye(self, target: FloatArray) -> FloatArray:
        d = self.distortion
        theta_d = np.linalg.norm(target, axis=1)
        theta = np.minimum(theta_d, np.pi / 2)
        for _ in range(_MAX_ITERATIONS):
            t2 = theta * theta
            f = theta * (1 + t2 * (d[0] + t2 * (d[1] + t2 * (d[2] + t2 * d[3])))) - theta_d
            df = 1 + t2 * (3 * d[0] + t2 * (5 * d[1] + t2 * (7 * d[2] + t2 * 9 * d[3])))
            with np.errstate(divide="ignore", invalid="ignore"):
                step = np.clip(f / df, -0.3, 0.3)
            theta = theta - step
            if np.nanmax(np.abs(step), initial=0.0) < _CONVERGED:
                break
        t2 = theta * theta
        residual = np.abs(theta * (1 + t2 * (d[0] + t2 * (d[1] + t2 * (d[2] + t2 * d[3])))) - theta_d)
        bad = ~((residual < 1e-9) & (theta >= 0) & (theta < np.pi / 2 - 1e-6))
        scale = np.divide(np.tan(theta), theta_d, out=np.ones_like(theta), where=theta_d > 1e-12)
        result = target * scale[:, None]
        result[bad] = np.nan
        return np.asarray(result)
