"""Products by oneDNN against PyTorch's own."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from thegra_core.features import products


@pytest.fixture(autouse=True)
def onednn(monkeypatch: pytest.MonkeyPatch) -> None:
    """On any processor, also where it does not pay."""
    if not torch.backends.mkldnn.is_available():
        pytest.skip("NOT TESTED, this build of PyTorch has no oneDNN: products are PyTorch's own here")
    assert products._works()
    monkeypatch.setattr(products, "_ONEDNN", True)


@pytest.mark.parametrize("rows", [1, 127, 128, 129, 700])
def test_linear_is_pytorchs(rows: int) -> None:
    generator = torch.Generator().manual_seed(rows)
    x, weight, bias = (torch.randn(*shape, generator=generator) for shape in ((1, rows, 96), (64, 96), (64,)))
    for offset in (bias, None):
        torch.testing.assert_close(products.Linear(weight, offset)(x), functional.linear(x, weight, offset), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("queries", "keys"), [(1, 1), (128, 128), (130, 5), (5, 130), (300, 257)])
def test_attention_is_pytorchs(queries: int, keys: int) -> None:
    """The rows of zeros that are added take no share: with values about 50 and scores about theirs it would show."""
    generator = torch.Generator().manual_seed(queries)
    query, key, value = (torch.randn(1, 4, n, 32, generator=generator) for n in (queries, keys, keys))
    key, value = key - 5.0, value + 50.0
    with torch.inference_mode():
        found, wanted = products.attention(query, key, value), functional.scaled_dot_product_attention(query, key, value)
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-3)


def test_few_sizes_reach_onednn(monkeypatch: pytest.MonkeyPatch) -> None:
    """It keeps code for each size that it meets."""
    sizes, multiply = set(), products._onednn

    def noted(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        sizes.add((tuple(x.shape), tuple(weight.shape)))
        return multiply(x, weight, bias)

    monkeypatch.setattr(products, "_onednn", noted)
    layer = products.Linear(torch.ones(8, 8), None)
    with torch.inference_mode():
        for count in range(513, 641):
            x = torch.ones(1, 1, count, 8)
            products.attention(x, x, layer(x))
    assert len(sizes) == 3
