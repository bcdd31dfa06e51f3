"""From a dense score map to keypoints."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def suppress(scores: Tensor, radius: int, rounds: int = 2) -> Tensor:
    """Scores (B, H, W) with everything but local maxima of a (2 radius + 1) square set to zero.

    After the first pass the neighbourhoods of the maxima are cleared and maxima of what is left are added, `rounds` times, so that a point beside a
    suppressed one is not lost with it.
    """

    def pooled(x: Tensor) -> Tensor:
        return functional.max_pool2d(x, 2 * radius + 1, stride=1, padding=radius)

    peaks = scores == pooled(scores)
    for _ in range(rounds):
        near = pooled(peaks.float()) > 0
        left = torch.where(near, 0.0, scores)
        peaks = peaks | ((left == pooled(left)) & ~near)
    return torch.where(peaks, scores, 0.0)


def strongest(peaks: Tensor, count: int, threshold: float, border: int) -> tuple[Tensor, Tensor]:
    """The `count` highest of the positive values of (H, W) above `threshold`, at least `border` px inside.

    Returns:
        keypoints (N, 2) float (x, y) pixels and their values (N,), highest first, ties in raster order.
    """
    inner = torch.zeros_like(peaks)
    height, width = peaks.shape
    inside = (slice(border, height - border), slice(border, width - border))
    inner[inside] = peaks[inside]
    index = (inner.flatten() > threshold).nonzero()[:, 0]
    values = inner.flatten()[index]
    order = torch.argsort(values, descending=True, stable=True)[:count]
    index = index[order]
    keypoints = torch.stack((index % width, index.div(width, rounding_mode="floor")), dim=1)
    return keypoints.to(peaks.dtype), values[order]
