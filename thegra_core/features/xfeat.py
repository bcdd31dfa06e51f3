"""XFeat (Potje et al. 2024) through kornia's network, with weights from the cache."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia.feature import XFeat as XFeatPipeline
from numpy.typing import NDArray

from thegra_core.config import ExtractorConfig
from thegra_core.features.assemble import assemble, scaled_image
from thegra_core.features.backends import Compiled, Replaced, chosen, export, exported_path
from thegra_core.features.checkpoint import load_checkpoint, load_exactly
from thegra_core.features.device import resolve_device
from thegra_core.messages import Features

_MULTIPLE = 32
OUTPUTS = ("features", "keypoints", "reliability")
"""Maps of the network, in its order."""


class XFeat:
    """`Extractor` with XFeat; keypoints are pixels of the image the network saw, with sides cut to multiples of 32 by resizing."""

    def __init__(self, config: ExtractorConfig) -> None:
        self.name: str = config.name
        self._config = config
        self._device = resolve_device(config.device)
        pipeline: Any = XFeatPipeline(top_k=config.max_keypoints, detection_threshold=config.detection_threshold)
        load_exactly(pipeline.net, load_checkpoint("xfeat"), "xfeat")
        self._pipeline = pipeline.eval().to(self._device)
        runtime = chosen(config.backend, self._device)
        if runtime != "torch":
            self._pipeline.net = Replaced(Compiled(self._pipeline.net, "xfeat", OUTPUTS, runtime, torch.get_num_threads()))

    @torch.inference_mode()
    def extract(self, image: NDArray[np.uint8], stamp_ns: int) -> Features:
        """See `Extractor.extract`."""
        config = self._config
        scaled, scale = scaled_image(image, config.long_side)
        grey = torch.from_numpy(np.ascontiguousarray(scaled)).to(self._device).float()[None, None] / 255
        found = self._pipeline.detectAndCompute(grey, top_k=4 * config.max_keypoints, detection_threshold=config.detection_threshold)[0]
        size = np.asarray([scaled.shape[1], scaled.shape[0]])
        seen = np.asarray(network_size((scaled.shape[1], scaled.shape[0])))
        # kornia scales pixel indices by the size ratio; pixel centres move by half the difference besides
        keypoints = found["keypoints"].cpu().numpy() + 0.5 * size / seen - 0.5
        return assemble(
            config, stamp_ns, (image.shape[1], image.shape[0]), scale, keypoints, found["scores"].cpu().numpy(), found["descriptors"].cpu().numpy()
        )


def network_size(image_size: tuple[int, int]) -> tuple[int, int]:
    """(width, height) of what the network sees of an image of that size."""
    width, height = (max(_MULTIPLE, side // _MULTIPLE * _MULTIPLE) for side in image_size)
    return width, height


def export_xfeat(image_size: tuple[int, int]) -> Path:
    """Write the network for images of a size (width, height) as the backends look for it; returns the file.

    Raises:
        WeightsError: If its weights are not in the cache.
        ConfigError: If the packages that export are missing.
    """
    path = exported_path("xfeat", network_size(image_size))
    pipeline = XFeatPipeline()
    load_exactly(pipeline.net, load_checkpoint("xfeat"), "xfeat")
    export(pipeline.net.eval(), network_size(image_size), OUTPUTS, path)
    return path
