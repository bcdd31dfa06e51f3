"""LightGlue (Lindenberger et al. 2023) for SuperPoint and ALIKED, and LighterGlue for XFeat, through kornia's network with weights from the cache."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from kornia.feature.lightglue import LightGlue as LightGlueNet
from torch import Tensor

from thegra_core.config import MatcherConfig
from thegra_core.errors import ConfigError
from thegra_core.features.checkpoint import load_checkpoint, load_exactly
from thegra_core.features.device import resolve_device
from thegra_core.features.lightglue_layers import speed_up
from thegra_core.messages import Features, Matches

CHECKPOINTS = {"superpoint": "superpoint_lightglue", "aliked": "aliked_lightglue", "aliked-n16rot": "aliked_lightglue", "xfeat": "xfeat-lighterglue"}
_KORNIA_NAMES = {"superpoint": "superpoint", "aliked": "aliked", "aliked-n16rot": "aliked", "xfeat": "xfeat"}


class LightGlue:
    """`Matcher` with a LightGlue network for one extractor's descriptors."""

    def __init__(self, config: MatcherConfig, extractor: str) -> None:
        self.name = "lighterglue" if extractor == "xfeat" else "lightglue"
        self._extractor = extractor
        self._device = resolve_device(config.device)
        checkpoint = CHECKPOINTS[extractor]
        network = LightGlueNet(**_network_settings(config, extractor))
        layers = int(network.conf.n_layers)
        # `confidence_thresholds` is derived from the number of layers; `log_assignment.i.r` was never used by the authors' code either
        unused = tuple(f"log_assignment.{layer}.r" for layer in range(layers))
        load_exactly(network, _renamed(load_checkpoint(checkpoint)), checkpoint, missing=("confidence_thresholds",), ignored_prefixes=unused)
        with torch.no_grad():
            speed_up(network)
        self._network = network.eval().to(self._device)

    @torch.inference_mode()
    def match(self, query: Features, reference: Features) -> Matches:
        """See `Matcher.match`."""
        for features in (query, reference):
            if features.extractor != self._extractor:
                raise ConfigError(f"this matcher is for {self._extractor} features, got {features.extractor}")
        if len(query) == 0 or len(reference) == 0:
            return Matches(query.stamp_ns, reference.stamp_ns, np.empty((0, 2), np.int32), np.empty(0, np.float32))
        result = self._network({"image0": self._inputs(query), "image1": self._inputs(reference)})
        indices, confidence = result["matches"][0], result["scores"][0]
        return Matches(query.stamp_ns, reference.stamp_ns, indices.cpu().numpy().astype(np.int32), confidence.cpu().numpy().clip(0, 1).astype(np.float32))

    def match_many(self, query: Features, references: Sequence[Features]) -> list[Matches]:
        """See `Matcher.match_many`."""
        return [self.match(query, reference) for reference in references]

    def _inputs(self, features: Features) -> dict[str, Tensor]:
        return {
            "keypoints": torch.from_numpy(features.keypoints).to(self._device)[None],
            "descriptors": torch.from_numpy(features.descriptors).to(self._device)[None],
            "image_size": torch.tensor([features.image_size], device=self._device),
        }


def _network_settings(config: MatcherConfig, extractor: str) -> dict[str, Any]:
    """kornia's settings of that extractor's network under ours; LighterGlue has no trained early exit, so it never exits early."""
    settings = {key: value for key, value in LightGlueNet.features[_KORNIA_NAMES[extractor]].items() if key != "weights"}
    settings["features"] = None  # a name here would download
    settings["filter_threshold"] = config.threshold
    if extractor == "xfeat":
        settings["width_confidence"] = min(config.width_confidence, settings["width_confidence"])
    else:
        settings["depth_confidence"] = config.depth_confidence
        settings["width_confidence"] = config.width_confidence
    return settings


def _renamed(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Keys of the older releases in the names of the newer ones, without the extractor's copy that LighterGlue's file carries."""
    renamed = {}
    for key, tensor in state.items():
        if key.startswith("extractor."):
            continue
        name = key.removeprefix("matcher.")
        for block in ("self_attn", "cross_attn"):
            if name.startswith(f"{block}."):
                _, layer, rest = name.split(".", 2)
                name = f"transformers.{layer}.{block}.{rest}"
        renamed[name] = tensor
    return renamed
