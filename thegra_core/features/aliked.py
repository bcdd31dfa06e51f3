"""ALIKED (Zhao et al. 2023): kornia's network with weights from the cache, evaluated only where it is needed."""

from __future__ import annotations

import numpy as np
import torch
from kornia.feature import ALIKED
from numpy.typing import NDArray

from thegra_core.config import ExtractorConfig
from thegra_core.features.aliked_sparse import SparseAliked
from thegra_core.features.assemble import assemble, scaled_image
from thegra_core.features.checkpoint import load_checkpoint, load_exactly
from thegra_core.features.detection import spread
from thegra_core.features.device import resolve_device
from thegra_core.messages import Features

NMS_RADIUS = 2
CANDIDATES = 4
"""Times the keypoints kept that are detected, so that the border and the choice by place leave enough."""
CHECKPOINTS = {"aliked": "aliked-n16", "aliked-n16rot": "aliked-n16rot"}


class Aliked:
    """`Extractor` with ALIKED; keypoints are refined below the pixel by the network's own soft-argmax."""

    def __init__(self, config: ExtractorConfig) -> None:
        self.name: str = config.name
        self._config = config
        self._device = resolve_device(config.device)
        checkpoint = CHECKPOINTS[config.name]
        # kornia's top-k mode is chosen by a threshold that is not positive; more are asked for than are kept because some lie in the border
        threshold = config.detection_threshold if config.detection_threshold > 0 else -1.0
        network = ALIKED(checkpoint, CANDIDATES * config.max_keypoints, threshold, config.nms_radius or NMS_RADIUS)
        load_exactly(network, load_checkpoint(checkpoint), checkpoint, missing=("dkd.hw_grid",))
        self._network = SparseAliked(network.eval().to(self._device))

    @torch.inference_mode()
    def extract(self, image: NDArray[np.uint8], stamp_ns: int) -> Features:
        """See `Extractor.extract`."""
        config = self._config
        scaled, scale = scaled_image(image, config.long_side)
        grey = torch.from_numpy(np.ascontiguousarray(scaled)).to(self._device).float()[None, None] / 255
        score_map, levels = self._network.dense(grey)
        (normalized,), (values,), _ = self._network.detect(score_map)
        size = normalized.new_tensor([scaled.shape[1] - 1, scaled.shape[0] - 1])
        pixels = (normalized + 1) / 2 * size
        border = config.border * min(scale)
        inside = ((pixels >= border) & (pixels <= size - border)).all(dim=1) & (values > config.detection_threshold)
        chosen = inside.nonzero()[:, 0]
        best = spread(pixels[chosen].cpu().numpy(), values[chosen].cpu().numpy(), config.max_keypoints, (scaled.shape[1], scaled.shape[0]), config.crowding)
        chosen = chosen[torch.from_numpy(best).to(chosen.device)]
        keypoints, scores = pixels[chosen], values[chosen]
        descriptors = self._network.describe(levels, keypoints)
        return assemble(
            config, stamp_ns, (image.shape[1], image.shape[0]), scale, keypoints.cpu().numpy(), scores.cpu().numpy(), descriptors.cpu().numpy()
        )
