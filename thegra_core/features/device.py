"""Where the networks run."""

from __future__ import annotations

from typing import TYPE_CHECKING

from thegra_core.errors import ConfigError

if TYPE_CHECKING:
    import torch


def resolve_device(name: str = "auto") -> torch.device:
    """The torch device of that name; `auto` takes CUDA where there is a GPU.

    Raises:
        ConfigError: If the device does not exist here.
    """
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ConfigError(f"unknown device {name!r}; use auto, cpu, cuda or cuda:0") from error
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise ConfigError(f"device {name!r} is not there ({torch.cuda.device_count()} CUDA devices); use: --set extractor.device=cpu --set matcher.device=cpu")
    return device


def accelerator_name() -> str | None:
    """What `auto` computes on if not on the processor, as the driver calls it."""
    import torch

    return torch.cuda.get_device_name() if torch.cuda.is_available() else None
