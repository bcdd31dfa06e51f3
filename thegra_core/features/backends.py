"""What computes the dense part of a network: torch itself, or a runtime that is faster on a processor, from the same weights."""

from __future__ import annotations

import importlib.util
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from thegra_core.errors import ConfigError
from thegra_core.features.weights import cache_dir, weight_named

logger = logging.getLogger(__name__)
RUNTIMES = ("openvino", "onnxruntime")
"""Besides torch, in the order in which `auto` takes them. Both take 0.8 of torch's time to detect with XFeat on an AVX2 processor (measured)."""
Arrays = tuple[NDArray[np.float32], ...]


def chosen(name: str, device: torch.device) -> str:
    """The backend that a `backend` setting stands for on that device.

    Raises:
        ConfigError: If it is not installed, or cannot compute there; says what to type.
    """
    if name == "auto":
        usable = device.type == "cpu" and _installed("onnx") and _installed("onnxscript")
        found = next((runtime for runtime in RUNTIMES if usable and _installed(runtime)), "torch")
        logger.info("networks that have a choice are computed by %s", found)
        return found
    if name in RUNTIMES and not _installed(name):
        raise ConfigError(f"backend {name} is not installed: pip install {name}")
    if name in RUNTIMES and device.type != "cpu":
        raise ConfigError(f"backend {name} computes on the CPU here: set extractor.device=cpu, or extractor.backend=torch")
    return name


class Replaced(nn.Module):
    """Takes the place of a network of a pipeline: one image (1, 1, H, W) in, some maps out."""

    def __init__(self, compute: Callable[[NDArray[np.float32]], Arrays]) -> None:
        super().__init__()
        self._compute = compute

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        """The maps as the network itself would give them."""
        return tuple(torch.from_numpy(array) for array in self._compute(image.numpy()))


class Compiled:
    """A network in a runtime; for each image size it is exported when one first comes, and kept in the cache of weights.

    Args:
        name: Of the weights.
        outputs: Names of the maps in the ONNX file.
    """

    def __init__(self, network: nn.Module, name: str, outputs: tuple[str, ...], runtime: str, threads: int) -> None:
        self._network, self._name, self._outputs = network, name, outputs
        self._open = {"openvino": _open_openvino, "onnxruntime": _open_onnxruntime}[runtime]
        self._threads = threads
        self._sessions: dict[tuple[int, int], Callable[[NDArray[np.float32]], Arrays]] = {}

    def __call__(self, image: NDArray[np.float32]) -> Arrays:
        """The maps of an image (1, 1, H, W)."""
        height, width = image.shape[-2:]
        if (height, width) not in self._sessions:
            path = exported_path(self._name, (width, height))
            if not path.is_file():
                export(self._network, (width, height), self._outputs, path)
            self._sessions[height, width] = self._open(path, self._threads)
        return self._sessions[height, width](np.ascontiguousarray(image))


def exported_path(name: str, size: tuple[int, int]) -> Path:
    """Where the network of those weights lies for images of a size (width, height)."""
    return cache_dir() / "onnx" / f"{name}_{weight_named(name).sha256[:12]}_{size[0]}x{size[1]}.onnx"


def export(network: nn.Module, size: tuple[int, int], outputs: tuple[str, ...], path: Path) -> None:
    """Write a network for images of a size (width, height) as an ONNX file, whole or not at all.

    Raises:
        ConfigError: If the packages that export are missing.
    """
    if not (_installed("onnx") and _installed("onnxscript")):
        raise ConfigError("exporting a network needs onnx and onnxscript: pip install onnx onnxscript")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.onnx")
    try:
        example = torch.zeros(1, 1, size[1], size[0])
        torch.onnx.export(
            network, (example,), str(temporary), dynamo=True, input_names=["image"], output_names=list(outputs), external_data=False, verbose=False
        )
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _installed(module: str) -> bool:
    return importlib.util.find_spec(module) is not None


def _open_onnxruntime(path: Path, threads: int) -> Callable[[NDArray[np.float32]], Arrays]:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    return lambda image: cast(Arrays, tuple(session.run(None, {"image": image})))


def _open_openvino(path: Path, threads: int) -> Callable[[NDArray[np.float32]], Arrays]:
    import openvino

    # its own choice of precision would depend on the processor; pinned, the networks of two processes would share one core
    settings: dict[str, Any] = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": threads, "PERFORMANCE_HINT": "LATENCY", "ENABLE_CPU_PINNING": False}
    model = openvino.Core().compile_model(str(path), "CPU", settings)
    return lambda image: tuple(np.array(value) for value in model([image]).values())
