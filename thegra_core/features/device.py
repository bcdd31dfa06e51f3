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


def use_threads(count: int) -> None:
    """Let the networks use `count` CPU threads: a setting of the whole process, made only where the user or the command line asks for it.

    More threads than idle cores cost dearly, because they wait for each other by spinning: measured on two busy cores, matching a pair took 0.28 s on
    one thread and 7 s on two (0.8 s with OMP_WAIT_POLICY=passive in the environment). One is the safe choice beside other work.
    """
    import torch

    torch.set_num_threads(count)
