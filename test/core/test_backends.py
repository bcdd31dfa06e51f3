"""Networks in other runtimes give what torch gives."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from thegra_core.config import ExtractorConfig
from thegra_core.errors import ConfigError, WeightsError
from thegra_core.features import backends
from thegra_core.features.backends import Compiled, Replaced, chosen
from thegra_core.features.registry import make_extractor
from thegra_core.features.weights import path_of

CPU = torch.device("cpu")
EXTRAS = {"onnxruntime": "onnx", "openvino": "openvino"}


def installed(runtime: str) -> None:
    for module in (runtime, "onnx", "onnxscript"):
        pytest.importorskip(module, reason=f"NOT TESTED, {module} is not installed: pip install -e .[{EXTRAS[runtime]}]")


class Small(torch.nn.Module):
    """Two maps of an image."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.conv = torch.nn.Conv2d(1, 3, 3, padding=1)

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        first = self.conv(image)
        return first, torch.nn.functional.avg_pool2d(torch.sigmoid(first), 4)


@pytest.mark.filterwarnings("ignore")  # the exporter's own
@pytest.mark.parametrize("runtime", backends.RUNTIMES)
def test_a_compiled_network_is_the_network(runtime: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    installed(runtime)
    monkeypatch.setenv("THEGRA_WEIGHTS", str(tmp_path))
    network = Small().eval()
    replaced = Replaced(Compiled(network, "xfeat", ("raw", "pooled"), runtime, 1))
    for size in ((64, 32), (32, 64)):
        image = torch.from_numpy(np.random.default_rng(0).random((1, 1, size[1], size[0]), np.float32))
        with torch.inference_mode():
            for expected, got in zip(network(image), replaced(image), strict=True):
                np.testing.assert_allclose(got.numpy(), expected.numpy(), atol=1e-5)
    assert len(list((tmp_path / "onnx").iterdir())) == 2, "one file for each size, and nothing half made"
    monkeypatch.setattr(backends, "export", lambda *_: pytest.fail("what is exported is not exported again"))
    Compiled(network, "xfeat", ("raw", "pooled"), runtime, 1)(np.zeros((1, 1, 32, 64), np.float32))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("runtime", backends.RUNTIMES)
def test_xfeat_finds_the_same_in_every_runtime(runtime: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keypoints within rounding of a score: all but one in two hundred are the same, with descriptors equal to 1e-3."""
    installed(runtime)
    try:
        weights = path_of("xfeat")
    except WeightsError as error:
        pytest.skip(f"NOT TESTED, {error}")
    image = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (128, 160), np.uint8), (0, 0), 2)
    image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX)
    expected = make_extractor(ExtractorConfig(name="xfeat", max_keypoints=200)).extract(image, 0)
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / weights.name).symlink_to(weights)
    monkeypatch.setenv("THEGRA_WEIGHTS", str(tmp_path / "weights"))
    got = make_extractor(ExtractorConfig(name="xfeat", max_keypoints=200, backend=runtime)).extract(image, 0)
    where = {tuple(k): i for i, k in enumerate(expected.keypoints.round(3).tolist())}
    pairs = [(i, where[tuple(k)]) for i, k in enumerate(got.keypoints.round(3).tolist()) if tuple(k) in where]
    assert len(pairs) >= 0.995 * len(expected) and len(expected) == len(got) == 200
    mine, theirs = (np.array(rows) for rows in zip(*pairs, strict=True))
    np.testing.assert_allclose(got.descriptors[mine], expected.descriptors[theirs], atol=1e-3)
    np.testing.assert_allclose(got.scores[mine], expected.scores[theirs], rtol=1e-3, atol=1e-4)


def test_auto_takes_what_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    there = {"onnx", "onnxscript", "onnxruntime", "openvino"}
    monkeypatch.setattr(backends, "_installed", lambda module: module in there)
    assert chosen("auto", CPU) == "openvino"
    there.discard("openvino")
    assert chosen("auto", CPU) == "onnxruntime"
    there.discard("onnxscript")
    assert chosen("auto", CPU) == "torch", "nothing could be exported"
    there.update({"onnxscript", "openvino"})
    assert chosen("auto", torch.device("cuda")) == "torch"
    assert chosen("torch", CPU) == "torch"


def test_a_backend_that_cannot_be_had_says_what_to_type(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends, "_installed", lambda _: False)
    with pytest.raises(ConfigError, match="pip install openvino"):
        chosen("openvino", CPU)
    monkeypatch.setattr(backends, "_installed", lambda _: True)
    with pytest.raises(ConfigError, match=r"extractor\.device=cpu"):
        chosen("onnxruntime", torch.device("cuda"))
