"""Rotations and rigid transforms as plain arrays: (3, 3) and (4, 4) float64, quaternions as (x, y, z, w)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
_SMALL_ANGLE = 1e-8


def skew(vectors: ArrayLike) -> FloatArray:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    v = np.asarray(vectors, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def so3_exp(rotation_vectors: ArrayLike) -> FloatArray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians (Rodrigues)."""
    w = np.asarray(rotation_vectors, dtype=np.float64)
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    k = skew(w)
    a = np.where(small, 1.0 - angle**2 / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    return np.asarray(np.eye(3) + a * k + b * (k @ k))


def so3_log(rotation: ArrayLike) -> FloatArray:
    """Rotation vector (3,), angle in [0, pi], of a rotation matrix (3, 3)."""
    x, y, z, w = quaternion_from_rotation(rotation)
    vector = np.array([x, y, z])
    sine = float(np.linalg.norm(vector))
    if sine < 1e-12:
        return 2.0 * vector
    return np.asarray(vector * (2.0 * np.arctan2(sine, w) / sine))


def rotation_angle(rotation: ArrayLike) -> float:
    """Angle in radians of a rotation matrix (3, 3)."""
    return float(np.linalg.norm(so3_log(rotation)))


def swing_and_twist(rotation: ArrayLike) -> tuple[float, float]:
    """Angles in radians of a rotation matrix (3, 3) taken apart into a twist about z and, after it, a swing about an axis in the plane of x and y.

    The swing, in [0, pi], is the angle between the z axes; the twist is in (-pi, pi], and means nothing where the swing is half a turn.
    """
    _, _, z, w = quaternion_from_rotation(rotation)
    twist = 2.0 * np.arctan2(z, w)
    cosine = np.asarray(rotation, dtype=np.float64)[2, 2]
    return float(np.arccos(np.clip(cosine, -1.0, 1.0))), float(twist)


def quaternion_from_rotation(rotation: ArrayLike) -> FloatArray:
    """Unit quaternion (x, y, z, w) with w >= 0 of a rotation matrix (3, 3) (Shepperd 1978: the largest component first)."""
    r = np.asarray(rotation, dtype=np.float64)
    trace = np.trace(r)
    squares = np.array([1 + 2 * r[0, 0] - trace, 1 + 2 * r[1, 1] - trace, 1 + 2 * r[2, 2] - trace, 1 + trace])
    i = int(np.argmax(squares))
    if i == 3:
        q = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], squares[3]])
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q = np.empty(4)
        q[i], q[j], q[k], q[3] = squares[i], r[j, i] + r[i, j], r[k, i] + r[i, k], r[k, j] - r[j, k]
    q = q / np.linalg.norm(q)
    return np.asarray(-q if q[3] < 0 else q)


def rotation_from_quaternion(quaternion: ArrayLike) -> FloatArray:
    """Rotation matrix (3, 3) of a quaternion (x, y, z, w) of any norm but zero."""
    q = np.asarray(quaternion, dtype=np.float64)
    x, y, z, w = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def nearest_rotation(matrix: ArrayLike) -> FloatArray:
    """The rotation (3, 3) closest to a matrix in the Frobenius norm."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=np.float64))
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt)


def transform(rotation: ArrayLike, translation: ArrayLike) -> FloatArray:
    """(4, 4) rigid transform of a rotation (3, 3) and a translation (3,)."""
    out = np.eye(4)
    out[:3, :3] = rotation
    out[:3, 3] = np.asarray(translation, dtype=np.float64).ravel()
    return out


def inverse(a_from_b: FloatArray) -> FloatArray:
    """b_from_a of a rigid transform (4, 4)."""
    rotation = a_from_b[:3, :3].T
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3], out[3, 3] = rotation, -rotation @ a_from_b[:3, 3], 1.0
    return out


def apply(a_from_b: FloatArray, points_b: FloatArray) -> FloatArray:
    """points_a (N, 3) of points_b (N, 3) under a (4, 4) transform (rigid or similarity)."""
    return np.asarray(points_b @ a_from_b[:3, :3].T + a_from_b[:3, 3])


def adjoint(a_from_b: FloatArray) -> FloatArray:
    """(6, 6), rotation first: carries a small motion of frame b, expressed in b, to the motion of a, expressed in a, that is rigidly tied to it."""
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = a_from_b[:3, :3]
    result[3:, :3] = skew(a_from_b[:3, 3]) @ a_from_b[:3, :3]
    return result


def interpolate(a_from_b0: FloatArray, a_from_b1: FloatArray, fraction: float) -> FloatArray:
    """Pose `fraction` of the way from the first to the second; beyond [0, 1] it extrapolates (constant velocity)."""
    relative = so3_log(a_from_b0[:3, :3].T @ a_from_b1[:3, :3])
    rotation = a_from_b0[:3, :3] @ so3_exp(fraction * relative)
    return transform(rotation, (1 - fraction) * a_from_b0[:3, 3] + fraction * a_from_b1[:3, 3])
