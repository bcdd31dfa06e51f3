"""SuperPoint (DeTone, Malisiewicz and Rabinovich, CVPR workshops 2018), written from the paper, for the authors' published weights.

Keypoints are pixels of the 65-way cell classification, so the published network's are integers; `subpixel` moves them to the centre of mass of their
3x3 scores. The descriptor map has one vector a cell of 8x8 pixels and is sampled bilinearly at the whole pixels, as it was trained.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from thegra_core.config import ExtractorConfig
from thegra_core.features.assemble import assemble, scaled_image
from thegra_core.features.checkpoint import load_checkpoint, load_exactly
from thegra_core.features.detection import centroids, spread, strongest, suppress
from thegra_core.features.device import resolve_device
from thegra_core.messages import Features

CELL = 8
"""Pixels a side of the detector's cells: three max-poolings of two."""
NMS_RADIUS = 4
CANDIDATES = 4


class SuperPoint:
    """`Extractor` with the SuperPoint network."""

    def __init__(self, config: ExtractorConfig) -> None:
        self.name: str = config.name
        self._config = config
        self._device = resolve_device(config.device)
        network = SuperPointNet()
        load_exactly(network, load_checkpoint("superpoint_v1"), "superpoint_v1")
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload] # half the time on a CPU
        self._network = network.eval().to(self._device)

    @torch.inference_mode()
    def extract(self, image: NDArray[np.uint8], stamp_ns: int) -> Features:
        """See `Extractor.extract`."""
        config = self._config
        scaled, scale = scaled_image(image, config.long_side)
        grey = torch.from_numpy(np.ascontiguousarray(scaled)).to(self._device).float()[None, None] / 255
        score_map, descriptor_map = self._network(grey)
        scores = score_map[0].cpu().numpy()
        border = max(1, round(config.border * min(scale)))
        peaks = suppress(scores, config.nms_radius or NMS_RADIUS)
        pixels, values = strongest(peaks, CANDIDATES * config.max_keypoints, config.detection_threshold, border)
        chosen = spread(pixels, values, config.max_keypoints, (scaled.shape[1], scaled.shape[0]), config.crowding)
        pixels, values = pixels[chosen], values[chosen]
        descriptors = sample_descriptors(descriptor_map[0], torch.from_numpy(pixels).to(self._device, torch.float32))
        keypoints = centroids(scores, pixels) if config.subpixel else pixels.astype(np.float32)
        return assemble(config, stamp_ns, (image.shape[1], image.shape[0]), scale, keypoints, values, descriptors.cpu().numpy())


class SuperPointNet(nn.Module):
    """The paper's network: a VGG encoder shared by a detector head (64 pixels of a cell and "no keypoint") and a descriptor head (256-D).

    Layer names are those of the published checkpoint.
    """

    def __init__(self) -> None:
        super().__init__()
        for stage, (inside, outside) in enumerate(((1, 64), (64, 64), (64, 128), (128, 128)), start=1):
            self.add_module(f"conv{stage}a", nn.Conv2d(inside, outside, 3, padding=1))
            self.add_module(f"conv{stage}b", nn.Conv2d(outside, outside, 3, padding=1))
        self.convPa, self.convPb = nn.Conv2d(128, 256, 3, padding=1), nn.Conv2d(256, CELL * CELL + 1, 1)
        self.convDa, self.convDb = nn.Conv2d(128, 256, 3, padding=1), nn.Conv2d(256, 256, 1)

    def forward(self, grey: Tensor) -> tuple[Tensor, Tensor]:
        """Dense outputs of (B, 1, H, W) in [0, 1]: scores (B, H', W') of the pixels of whole cells, unit descriptors (B, 256, H'/8, W'/8)."""
        x = grey.contiguous(memory_format=torch.channels_last)
        for stage in range(1, 5):
            x = self.get_submodule(f"conv{stage}a")(x).relu_()
            x = self.get_submodule(f"conv{stage}b")(x).relu_()
            if stage < 4:
                x = functional.max_pool2d(x, 2)
        cells = self.convPb(self.convPa(x).relu_()).softmax(dim=1)[:, :-1]
        descriptors = functional.normalize(self.convDb(self.convDa(x).relu_()), dim=1)
        return functional.pixel_shuffle(cells, CELL)[:, 0], descriptors


def sample_descriptors(descriptor_map: Tensor, keypoints: Tensor) -> Tensor:
    """Unit descriptors (N, C) of keypoints (N, 2) px from a map (C, h, w) of 8x8 cells.

    The grid is the one LightGlue was trained with: pixel s/2 - 1/2 is the centre of the first cell, and the last cell's centre is one pixel
    further in than half a cell from the edge would have it (released SuperPoint and LightGlue code).
    """
    size = keypoints.new_tensor([descriptor_map.shape[-1], descriptor_map.shape[-2]])
    grid = (keypoints - CELL / 2 + 0.5) / (size * CELL - CELL / 2 - 0.5) * 2 - 1
    sampled = functional.grid_sample(descriptor_map[None], grid[None, None], mode="bilinear", align_corners=True)[0, :, 0]
    return functional.normalize(sampled.t(), dim=1)
