"""Matrix products on the CPU: by oneDNN where the processor has AVX-512, else as PyTorch does them.

PyTorch gives float32 products to MKL, which on processors that are not Intel's leaves half of AVX-512's width unused (measured on an AMD EPYC: 115 GFLOP/s
a core against oneDNN's 260; on an EPYC that has AVX2 alone both reach 75, and PyTorch's own attention takes 0.6 of the time of the one here).
oneDNN is part of PyTorch; its linear operator is the one `torch.compile` emits. It compiles code for each size of matrix that it meets and
keeps it, most of a megabyte each. So numbers of keypoints are rounded up: `thegra benchmark realtime` measured up to 2.4 GB of memory without, up to 1.2 with.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

ROWS = 128
"""Rows of a matrix are made a multiple of this by zeros."""


class Linear(nn.Module):
    """`nn.Linear` for inference, in float32 throughout; results differ from it by rounding alone."""

    def __init__(self, weight: Tensor, bias: Tensor | None) -> None:
        super().__init__()
        self.weight = nn.Parameter(weight.detach().clone().contiguous(), requires_grad=False)
        self.bias = None if bias is None else nn.Parameter(bias.detach().clone().contiguous(), requires_grad=False)

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) to (..., outputs)."""
        return _onednn_linear(x, self.weight, self.bias) if _serves(x) else functional.linear(x, self.weight, self.bias)


def attention(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """Scaled dot-product attention of one pair: (1, heads, N, C) queries, (1, heads, M, C) keys and values to (1, heads, N, C)."""
    if not (_serves(query) and _serves(key)) or len(query) != 1:
        return functional.scaled_dot_product_attention(query, key, value)
    heads, rows, width = query.shape[1:]
    count = key.shape[2]
    # strided operands would send oneDNN to its reference implementation, hundreds of times slower
    scaled, keys, values = _filled(query[0] * width**-0.5), _filled(key[0]), _filled(value[0])
    messages = torch.empty_like(query, memory_format=torch.contiguous_format)
    for head in range(heads):
        weights = _onednn(scaled[head], keys[head], None)
        weights[:, count:] = -torch.inf
        torch.softmax(weights, dim=-1, out=weights)
        messages[0, head] = _onednn(weights, values[head].t().contiguous(), None)[:rows]
    return messages


def _onednn_linear(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    return _onednn(_filled(x), weight, bias)[..., : x.shape[-2], :]


def _filled(x: Tensor) -> Tensor:
    """(..., N, C) with rows of zeros up to a multiple of `ROWS`, contiguous."""
    missing = -x.shape[-2] % ROWS
    return functional.pad(x, (0, 0, 0, missing)) if missing else x.contiguous()


def _onednn(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    product: Tensor = torch.ops.mkldnn._linear_pointwise(x, weight, bias, "none", [], "")
    return product


def _serves(x: Tensor) -> bool:
    return _ONEDNN and x.device.type == "cpu" and x.dtype == torch.float32 and x.numel() > 0 and x.dim() > 1


def _pays() -> bool:
    return torch.backends.cpu.get_cpu_capability() == "AVX512"


def _works() -> bool:
    """Whether this build of PyTorch has the operator, and it computes what it should."""
    x, weight, bias = torch.ones(2, 3), torch.ones(4, 3), torch.ones(4)
    try:
        result = _onednn(x, weight, bias)
    except (AttributeError, RuntimeError, NotImplementedError):
        return False
    return torch.equal(result, torch.full((2, 4), 4.0))


_ONEDNN = torch.backends.mkldnn.is_available() and _pays() and _works()
