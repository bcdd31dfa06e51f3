"""LightGlue's transformer layers with their weights rearranged once, at loading, so that a layer takes fewer passes over memory.

The arithmetic is the published network's (Lindenberger et al. 2023, Sec. 3): the output projection of each attention is folded into the layer that
follows it, query, key and value come out of one product in the order attention wants them, rotary pairs lie in two halves instead of interleaved,
and attention never forms the full similarity matrix. Results differ by rounding alone.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from thegra_core.features.products import Linear, attention


def speed_up(network: Any) -> None:
    """Replace the layers and the positional encoding of a loaded, evaluation-mode kornia `LightGlue` by equal ones that cost less on a CPU."""
    network.transformers = nn.ModuleList(_Layer(layer) for layer in network.transformers)
    network.posenc = _RotaryEncoding(network.posenc)


class _RotaryEncoding(nn.Module):
    """Cosine and sine (2, B, 1, N, head / 2) of the projected keypoints (B, N, 2), each once instead of twice."""

    def __init__(self, published: Any) -> None:
        super().__init__()
        self.Wr = published.Wr

    def forward(self, keypoints: Tensor) -> Tensor:
        angles = self.Wr(keypoints)
        return torch.stack((angles.cos(), angles.sin())).unsqueeze(-3)


class _Layer(nn.Module):
    """Self-attention in each image, then cross-attention between them."""

    def __init__(self, published: Any) -> None:
        super().__init__()
        own, cross = published.self_attn, published.cross_attn
        self._heads = own.num_heads
        self._own_projection = _reordered(own.Wqkv, own.num_heads)
        self._own_update = _Update(own.out_proj, own.ffn)
        self._cross_projection = Linear(torch.cat((cross.to_qk.weight, cross.to_v.weight)), torch.cat((cross.to_qk.bias, cross.to_v.bias)))
        self._cross_update = _Update(cross.to_out, cross.ffn)

    def forward(
        self, x0: Tensor, x1: Tensor, encoding0: Tensor, encoding1: Tensor, mask0: Tensor | None = None, mask1: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Descriptors (B, N, D) of both images after this layer; the masks of kornia's signature are for its padded batches, which are not used."""
        x0, x1 = self._attend_own(x0, encoding0), self._attend_own(x1, encoding1)
        (key0, value0), (key1, value1) = (self._split(self._cross_projection(x), 2) for x in (x0, x1))
        message0 = attention(key0, key1, value1)
        message1 = attention(key1, key0, value0)
        return self._cross_update(x0, message0), self._cross_update(x1, message1)

    def _attend_own(self, x: Tensor, encoding: Tensor) -> Tensor:
        query, key, value = self._split(self._own_projection(x), 3)
        message = attention(_rotate(query, encoding), _rotate(key, encoding), value)
        return self._own_update(x, message)  # type: ignore[no-any-return]

    def _split(self, x: Tensor, parts: int) -> tuple[Tensor, ...]:
        """(B, N, parts * D) into parts of (B, heads, N, D / heads)."""
        batch, count, width = x.shape
        return x.view(batch, count, parts, self._heads, width // parts // self._heads).permute(2, 0, 3, 1, 4).unbind(0)


class _Update(nn.Module):
    """x + MLP([x, projection(message)]) with the projection folded into the MLP's first layer."""

    def __init__(self, projection: Any, mlp: Any) -> None:
        super().__init__()
        first, norm, activation, last = mlp
        own, other = first.weight.split(first.weight.shape[1] // 2, dim=1)
        folded = Linear(torch.cat((own, other @ projection.weight), dim=1), first.bias + other @ projection.bias)
        self._mlp = nn.Sequential(folded, norm, activation, Linear(last.weight, last.bias))

    def forward(self, x: Tensor, message: Tensor) -> Tensor:
        hidden = torch.cat((x, message.transpose(1, 2).flatten(2)), dim=-1)
        return self._mlp(hidden).add_(x)  # type: ignore[no-any-return]


def _reordered(projection: Any, heads: int) -> Linear:
    """The joint projection from (head, channel, [q k v]) to ([q k v], head, channel), rotary pairs as two halves in q and k."""
    size = projection.out_features // heads // 3
    order = torch.arange(projection.out_features).view(heads, size, 3).permute(2, 0, 1)
    halves = torch.cat((torch.arange(0, size, 2), torch.arange(1, size, 2)))
    index = torch.cat((order[:2, :, halves].flatten(), order[2].flatten()))
    return Linear(projection.weight[index], projection.bias[index])


def _rotate(x: Tensor, encoding: Tensor) -> Tensor:
    """Rotate the pairs (x[i], x[i + half]) by their angles."""
    cosine, sine = encoding[0], encoding[1]
    first, second = x.chunk(2, dim=-1)
    return torch.cat((first * cosine - second * sine, second * cosine + first * sine), dim=-1)
