"""Reading checkpoints from the cache, and loading them so that a file of another network is an error."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import torch
from torch import Tensor, nn

from thegra_core.errors import WeightsError
from thegra_core.features.weights import path_of


def load_checkpoint(name: str) -> dict[str, Tensor]:
    """Tensors of the named weights on the CPU; nothing but tensors is unpickled.

    Raises:
        WeightsError: If the file is absent, damaged or not a checkpoint.
    """
    path = path_of(name)
    try:
        return dict(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # torch raises half a dozen types for a damaged file
        raise WeightsError(f"{path} cannot be read as weights ({error}); check it with: thegra weights verify") from error


def load_exactly(
    module: nn.Module, state: Mapping[str, Tensor], name: str, missing: Collection[str] = (), ignored_prefixes: tuple[str, ...] = ()
) -> None:
    """Load `state`, allowing exactly the given derived buffers to be missing and the given unused tensors to be there.

    Raises:
        WeightsError: If any other key is missing or unexpected, or a shape differs.
    """
    try:
        result = module.load_state_dict(dict(state), strict=False)
    except RuntimeError as error:
        raise WeightsError(f"the weights {name!r} do not fit the network: {error}; check them with: thegra weights verify") from error
    wrong = sorted(set(result.missing_keys) - set(missing)) + sorted(k for k in result.unexpected_keys if not k.startswith(ignored_prefixes or ("\0",)))
    if wrong:
        raise WeightsError(f"the weights {name!r} do not fit the network ({', '.join(wrong[:5])}); check them with: thegra weights verify")
