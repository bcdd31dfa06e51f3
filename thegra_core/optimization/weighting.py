"""Observation weights from detection scores (paper Sec. III-D, Eq. 1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

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
