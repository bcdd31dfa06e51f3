"""ALIKED without its dense descriptor map.

The published network upsamples four feature maps to the image's size, concatenates and normalises them, and then reads a few thousand places of the
result: three quarters of its time on a CPU. Here the maps stay small. The score head's first layer is a 1x1 convolution, which commutes with
bilinear upsampling, so it runs on the small maps; descriptors are read from them at the places that the descriptor head asks for. The results are
the published network's but for rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

_MULTIPLE = 32


@dataclass(frozen=True, slots=True)
class Levels:
    """Feature maps (1, C, h, w) of one padded image at 1, 1/2, 1/8 and 1/32 of its size; corner (x, y) and size (w, h) of the image in it."""

    maps: tuple[Tensor, ...]
    corner: Tensor
    size: Tensor
    padded: Tensor


class SparseAliked:
    """An evaluation-mode kornia `ALIKED`, run sparsely."""

    def __init__(self, network: Any) -> None:
        self._network = network
        self.detect = network.dkd
        for block in (network.block1, network.block2):
            for index in (1, 2):
                setattr(block, f"conv{index}", fuse_conv_bn_eval(getattr(block, f"conv{index}"), getattr(block, f"bn{index}")))
                setattr(block, f"bn{index}", nn.Identity())
        for block in (network.block3, network.block4):
            block.conv1, block.conv2 = _DeformableConv(block.conv1), _DeformableConv(block.conv2)
        first = network.block1.conv1  # the three colours of a grey image are equal: their weights add up
        first.weight = nn.Parameter(first.weight.sum(dim=1, keepdim=True), requires_grad=False)
        network.to(memory_format=torch.channels_last)

    def dense(self, grey: Tensor) -> tuple[Tensor, Levels]:
        """Score map (1, 1, H, W) in (0, 1) and feature maps of an image (1, 1, H, W) in [0, 1]."""
        net = self._network
        image, corner = _pad(grey)
        x1 = net.block1(image.contiguous(memory_format=torch.channels_last))
        x2 = net.block2(net.pool2(x1))
        x3 = net.block3(net.pool4(x2))
        x4 = net.block4(net.pool4(x3))
        maps = tuple(net.gate(conv(x)) for conv, x in ((net.conv1, x1), (net.conv2, x2), (net.conv3, x3), (net.conv4, x4)))
        height, width = grey.shape[-2:]
        top, left = corner[1], corner[0]
        scores = self._scores(maps)[..., top : top + height, left : left + width]
        levels = Levels(maps, grey.new_tensor(corner), grey.new_tensor([width, height]), grey.new_tensor([image.shape[-1], image.shape[-2]]))
        return scores, levels

    def _scores(self, maps: tuple[Tensor, ...]) -> Tensor:
        first, *rest = self._network.score_head
        weights = first.weight.split([level.shape[1] for level in maps], dim=1)
        size = maps[0].shape[-2:]
        total = functional.conv2d(maps[0], weights[0])
        for level, weight in zip(maps[1:], weights[1:], strict=True):
            total += functional.interpolate(functional.conv2d(level, weight), size, mode="bilinear", align_corners=True)
        for layer in rest:
            total = layer(total)
        return total.sigmoid()

    def describe(self, levels: Levels, keypoints: Tensor) -> Tensor:
        """Unit descriptors (N, C) at keypoints (N, 2) px: the network's deformable descriptor head on features read where it asks for them."""
        head = self._network.desc_head
        if len(keypoints) == 0:
            return keypoints.new_empty((0, head.sf_conv.out_channels))
        offsets = self._offsets(levels, keypoints)
        features = _bilinear(levels, (keypoints[:, None] + offsets).flatten(0, 1))
        features = functional.selu(features.t() @ head.sf_conv.weight[:, :, 0, 0].t())
        aggregate = head.agg_weights.flatten(0, 1)  # (positions * C, C)
        return functional.normalize(features.reshape(len(keypoints), -1) @ aggregate, dim=1)

    def _offsets(self, levels: Levels, keypoints: Tensor) -> Tensor:
        """(N, positions, 2) px: where the head wants to look, from the k x k pixels around each keypoint."""
        head = self._network.desc_head
        k = head.kernel_size
        corner = (keypoints.long() - k / 2 + 1).long()
        corner = torch.minimum(corner.clamp(min=0), (levels.size - 1 - k).long())
        steps = torch.arange(k, device=keypoints.device)
        window = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1).reshape(-1, 2)  # row by row, (x, y)
        patch = _at_pixels(levels, (corner[:, None] + window).flatten(0, 1).to(keypoints.dtype))
        patch = patch.reshape(-1, len(keypoints), k, k).transpose(0, 1)
        limit = float(levels.size.max()) / 4
        return head.offset_conv(patch).clamp(-limit, limit).reshape(len(keypoints), 2, head.n_pos).transpose(1, 2)  # type: ignore[no-any-return]


class _DeformableConv(nn.Module):
    """kornia's deformable convolution (3x3, stride 1), its samples taken by `grid_sample` instead of four gathers."""

    def __init__(self, conv: Any) -> None:
        super().__init__()
        self.offset_conv, self.weight, self.bias = conv.offset_conv, conv.regular_conv.weight, conv.regular_conv.bias

    def forward(self, x: Tensor) -> Tensor:
        """(1, C, H, W) to (1, C', H, W)."""
        height, width = x.shape[-2:]
        k = self.weight.shape[-1]
        limit = max(height, width) / 4
        offsets = self.offset_conv(x).clamp(-limit, limit).reshape(k * k, 2, height, width)  # (dy, dx) per tap
        rows, columns, taps = (torch.arange(n, device=x.device, dtype=x.dtype) for n in (height, width, k))
        y = offsets[:, 0] + rows[:, None] + (taps - k // 2).repeat_interleave(k)[:, None, None]
        x_positions = offsets[:, 1] + columns + (taps - k // 2).repeat(k)[:, None, None]
        grid = torch.stack((x_positions / max(1, width - 1) * 2 - 1, y / max(1, height - 1) * 2 - 1), dim=-1)
        sampled = functional.grid_sample(x, grid.reshape(1, -1, width, 2), mode="bilinear", padding_mode="zeros", align_corners=True)
        out: Tensor = (self.weight.flatten(1) @ sampled.reshape(-1, height * width)).reshape(1, -1, height, width)  # over channels and taps
        return out if self.bias is None else out + self.bias[:, None, None]


def _pad(grey: Tensor) -> tuple[Tensor, tuple[int, int]]:
    """The image with its edge repeated to sides that are multiples of 32, and where its corner (x, y) is now; the network's own padding."""
    height, width = grey.shape[-2:]
    extra_x, extra_y = -width % _MULTIPLE, -height % _MULTIPLE
    left, top = extra_x // 2, extra_y // 2
    return functional.pad(grey, (left, extra_x - left, top, extra_y - top), mode="replicate"), (left, top)


def _at_pixels(levels: Levels, pixels: Tensor) -> Tensor:
    """Normalised features (C, M) of the dense map at whole pixels (M, 2) of the image."""
    sampled = _sample(levels, pixels)
    return torch.cat(sampled) * _inverse_norm(sampled)


def _bilinear(levels: Levels, pixels: Tensor) -> Tensor:
    """Features (C, M) of the dense map between pixels (M, 2): bilinear of the normalised pixels around, zero outside the image."""
    base = pixels.floor()
    corners = torch.stack([base + base.new_tensor(step) for step in ((0, 0), (1, 0), (0, 1), (1, 1))])
    x, y = (pixels - base).unbind(dim=1)
    weights = torch.stack(((1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y))
    weights = weights * ((corners >= 0) & (corners < levels.size)).all(dim=-1)
    sampled = _sample(levels, torch.minimum(corners.clamp(min=0), levels.size - 1).flatten(0, 1))
    shares = weights * _inverse_norm(sampled).view_as(weights)
    return torch.cat([(level.reshape(-1, 4, len(pixels)) * shares).sum(dim=1) for level in sampled])


def _sample(levels: Levels, pixels: Tensor) -> list[Tensor]:
    """What the dense map would hold before normalisation at whole pixels (M, 2) of the image, (C, M) per level."""
    grid = ((pixels + levels.corner) / (levels.padded - 1) * 2 - 1)[None, None]
    return [functional.grid_sample(level, grid, mode="bilinear", align_corners=True)[0, :, 0] for level in levels.maps]


def _inverse_norm(sampled: list[Tensor]) -> Tensor:
    """(M,) one over the norm of the concatenated levels, as `functional.normalize` takes it."""
    squares = torch.stack([level.square().sum(dim=0) for level in sampled]).sum(dim=0)
    return squares.sqrt().clamp(min=1e-12).reciprocal()
