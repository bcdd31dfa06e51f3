"""Observation weights: from detection scores (paper Sec. III-D, Eq. 1), and from what is left of a landmark's errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MIN_RELATIVE_SCORE, MAX_RELATIVE_SCORE = 0.5, 2.0
"""Limits of a score over its keyframe's median: a weight is at most 4 times, at least a quarter of, the ordinary one."""


def observation_weights(scores: NDArray[np.float32], weighting: str) -> FloatArray:
    """Information (N,) in 1/px^2 of each keypoint of one frame from its detection scores (N,) in (0, 1].

    These weigh the cost; whether an observation is an outlier is asked of its pixel residual alone. With the literal weight in that test, too, a point of
    score 0.1 would pass up to 24 px, and the map would keep wrong observations (measured: a fifth of all in a corridor, and twice the drift of scale).

    paper: score^2, the standard deviation of a pixel is 1 / score. normalized: the square of the score over the frame's median, clamped,
    so that an ordinary keypoint has a standard deviation of 1 px whatever the contrast. uniform: 1.
    """
    values = np.asarray(scores, dtype=np.float64)
    if weighting == "uniform" or len(values) == 0:
        return np.ones(len(values))
    if weighting == "paper":
        return np.asarray(values**2)
    median = float(np.median(values))
    relative = values / median if median > 0 else np.ones_like(values)
    return np.asarray(np.clip(relative, MIN_RELATIVE_SCORE, MAX_RELATIVE_SCORE) ** 2)


def landmark_weights(squared_errors: FloatArray, landmarks: IntArray, used: BoolArray, count: int, freedom: float) -> FloatArray:
    """Factors (M,) on the weights of observations: those of a landmark whose errors are large count less, all alike.

    What is followed does not err anew in each image: where a square slides along an edge, or lies across one, it is off by much the same in many, and one such
    landmark bends the map more than as many single errors would. Each landmark's errors are taken for normal with a variance of its own, the inverse of which
    is gamma distributed about that of the median landmark: together they follow a multivariate Student t distribution (Lange, Little and Taylor 1989), and
    these are the weights of its maximum likelihood by iterated least squares.

    squared_errors (M,) px^2, of landmark `landmarks` (M,) of `count`; only those `used` (M,) tell its variance. freedom: degrees of freedom; the more, the more
    alike the factors.
    """
    dimensions = 2 * np.bincount(landmarks[used], minlength=count)
    sums = np.bincount(landmarks[used], squared_errors[used], minlength=count)
    seen = dimensions > 0
    ordinary = float(np.median(sums[seen] / dimensions[seen])) if np.any(seen) else 0.0
    if ordinary <= 0:
        return np.ones(len(landmarks))
    return np.asarray(((freedom + dimensions) / (freedom + sums / ordinary))[landmarks])
