"""Chambolle's total-variation denoising (J. Math. Imaging and Vision 20, 2004), fast enough for a live camera.

The iteration, its start and its stop are those of scikit-image's `denoise_tv_chambolle`, so that a paper's parameters mean the same here.
It runs in float32, compiled by numba: one pass over the image a step, row by row, so that what a row needs is still in the processor's cache.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]

_TAU = np.float32(0.25)
_ONE = np.float32(1)
# Images are finite, and a sum may be taken in any order: then a loop becomes vector instructions.
_compile = numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")


def denoise(values: Float32Array, weight: float, eps: float, max_iterations: int) -> Float32Array:
    """Minimise |out - values|^2 / (2 weight) + TV(out) by at most `max_iterations` steps.

    With s the dual variable over the weight and u the image times tau / weight, one step is d = div s, u = base + tau d, then
    s = (s - grad u) / (1 + |grad u|).

    Args:
        values: (H, W) finite grey levels.
        weight: Grey levels; larger is smoother.
        eps: Stops when the cost changes by less than this share of its first value.
        max_iterations: At least 1; 1 gives the values back.
    """
    height, width = values.shape
    middle = np.float32(0.5) * (values.min() + values.max())  # small numbers keep float32 exact enough
    base = (values - middle) * np.float32(_TAU / weight)
    down = np.zeros((height + 1, width), np.float32)  # row 0 is above the image
    right = np.zeros((height, width + 1), np.float32)  # column 0 is left of the image
    image = np.empty((height, width + 1), np.float32)  # the last column repeats the one before
    first = previous = 0.0
    for iteration in range(max_iterations):
        cost = _step(base, down, right, image)
        if iteration == 0:
            first = cost
        elif abs(previous - cost) < eps * first:
            break
        previous = cost
    result: Float32Array = image[:, :-1] * np.float32(weight / _TAU) + middle
    return result


@_compile
def _step(base: Float32Array, down: Float32Array, right: Float32Array, image: Float32Array) -> float:
    """Write u of the present dual into `image`, then move the dual; returns the cost. u is one row ahead, as the dual needs the next row of it."""
    height = len(base)
    squared, length = _image_row(base[0], down[0], down[1], right[0, :-1], right[0, 1:], image[0]), 0.0
    for y in range(height):
        below = min(y + 1, height - 1)
        if below > y:
            squared += _image_row(base[below], down[below], down[below + 1], right[below, :-1], right[below, 1:], image[below])
        length += _dual_row(image[y, :-1], image[y, 1:], image[below, :-1], down[y + 1], right[y, 1:])
    return squared + length / float(_TAU)


@_compile
def _image_row(base: Float32Array, above: Float32Array, down: Float32Array, left: Float32Array, right: Float32Array, image: Float32Array) -> float:
    squared = np.float32(0)
    for x in range(base.size):
        divergence = above[x] - down[x] + left[x] - right[x]
        squared += divergence * divergence
        image[x] = base[x] + _TAU * divergence
    image[-1] = image[-2]
    return squared  # type: ignore[return-value]


@_compile
def _dual_row(image: Float32Array, right_of: Float32Array, below: Float32Array, down: Float32Array, right: Float32Array) -> float:
    length = np.float32(0)
    for x in range(image.size):
        gradient_down, gradient_right = below[x] - image[x], right_of[x] - image[x]
        norm = np.sqrt(gradient_down * gradient_down + gradient_right * gradient_right)
        length += norm
        share = _ONE / (_ONE + norm)
        down[x] = (down[x] - gradient_down) * share
        right[x] = (right[x] - gradient_right) * share
    return length  # type: ignore[return-value]
