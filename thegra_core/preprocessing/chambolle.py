"""Chambolle's total-variation denoising (J. Math. Imaging and Vision 20, 2004), fast enough for a live camera.

The iteration, its start and its stop are those of scikit-image's `denoise_tv_chambolle`, so that a paper's parameters mean the same here.
It runs in float32 over strips of rows small enough to stay in the processor's cache, gradient and dual update in one sweep.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]

_TAU = 0.25
_STRIP_PIXELS = 32768


@dataclass(frozen=True, slots=True)
class _Strip:
    """Views of one strip of rows: what is read and written while it is swept.

    With s the dual variable over the weight and u the image times tau / weight, one step is d = div s, u = base + tau d, then
    s = (s - grad u) / (1 + |grad u|). u is kept one row ahead of s, which needs the next row of u and the row above of the old s.
    """

    divergence: Float32Array
    divergence_right: Float32Array
    down: Float32Array
    down_above: Float32Array
    right: Float32Array
    right_left: Float32Array
    base: Float32Array
    image: Float32Array
    image_here: Float32Array
    image_below: Float32Array
    image_flat: Float32Array
    image_next: Float32Array
    gradient_down: Float32Array
    gradient_right: Float32Array
    gradient_right_flat: Float32Array
    gradient_last_column: Float32Array
    norm: Float32Array
    dual_down: Float32Array
    dual_right: Float32Array

    def divide(self) -> float:
        """Divergence and image of the strip; returns the sum of the squared divergence."""
        np.subtract(self.down_above, self.down, out=self.divergence)
        np.subtract(self.divergence, self.right, out=self.divergence)
        np.add(self.divergence_right, self.right_left, out=self.divergence_right)
        cv2.scaleAdd(self.divergence, _TAU, self.base, self.image)
        return float(cv2.norm(self.divergence, cv2.NORM_L2SQR))

    def update(self) -> float:
        """Step of the dual variable; returns the sum of the gradient's length."""
        np.subtract(self.image_below, self.image_here, out=self.gradient_down)
        np.subtract(self.image_next, self.image_flat, out=self.gradient_right_flat)
        self.gradient_last_column.fill(0)
        cv2.magnitude(self.gradient_down, self.gradient_right, self.norm)
        length = float(cv2.sumElems(self.norm)[0])
        np.add(self.norm, 1, out=self.norm)
        for dual, gradient in ((self.dual_down, self.gradient_down), (self.dual_right, self.gradient_right)):
            np.subtract(dual, gradient, out=dual)
            np.divide(dual, self.norm, out=dual)
        return length


def denoise(values: Float32Array, weight: float, eps: float, max_iterations: int) -> Float32Array:
    """Minimise |out - values|^2 / (2 weight) + TV(out) by at most `max_iterations` steps.

    Args:
        values: (H, W) grey levels.
        weight: Grey levels; larger is smoother.
        eps: Stops when the cost changes by less than this share of its first value.
        max_iterations: At least 1; 1 gives the values back.
    """
    height, width = values.shape
    middle = np.float32(0.5) * (values.min() + values.max())  # small numbers keep float32 exact enough
    base = (values - middle) * np.float32(_TAU / weight)
    image = np.empty((height + 2, width), np.float32)  # two more rows: below the last one, and for the pixel after the last
    image[:height] = base
    strips = _make_strips(base, image)
    first = previous = 0.0
    for iteration in range(max_iterations):
        cost = 0.0
        for strip in strips:
            if iteration:
                cost += strip.divide()
            if strip is strips[-1]:
                image[height:] = image[height - 1]
            cost += strip.update() / _TAU
        if iteration == 0:
            first = cost
        elif abs(previous - cost) < eps * first:
            break
        previous = cost
    result: Float32Array = image[:height] * np.float32(weight / _TAU) + middle
    return result


def _make_strips(base: Float32Array, image: Float32Array) -> list[_Strip]:
    height, width = base.shape
    rows = max(1, _STRIP_PIXELS // width)
    down = np.zeros((height + 1, width), np.float32)  # row 0 is the one above the image
    right = np.zeros((height, width), np.float32)
    divergence, gradient_down, gradient_right, norm = (np.empty((min(rows, height) + 1, width), np.float32) for _ in range(4))
    flat = image.reshape(-1)
    strips = []
    for a in range(0, height, rows):
        b = min(a + rows, height)
        low, high = a + 1 if a else 0, min(b + 1, height)  # rows of u that are made before rows a..b of the dual
        n, m = b - a, high - low
        right_flat = right[low:high].reshape(-1)
        strips.append(_Strip(
            divergence=divergence[:m], divergence_right=divergence[:m].reshape(-1)[1:], down=down[low + 1 : high + 1], down_above=down[low:high],
            right=right[low:high], right_left=right_flat[:-1], base=base[low:high], image=image[low:high],
            image_here=image[a:b], image_below=image[a + 1 : b + 1], image_flat=flat[a * width : b * width], image_next=flat[a * width + 1 : b * width + 1],
            gradient_down=gradient_down[:n], gradient_right=gradient_right[:n], gradient_right_flat=gradient_right[:n].reshape(-1),
            gradient_last_column=gradient_right[:n, -1], norm=norm[:n], dual_down=down[a + 1 : b + 1], dual_right=right[a:b],
        ))  # fmt: skip
    return strips
