"""XFeat (Potje et al. 2024) through kornia's network, with weights from the cache."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from kornia.feature import XFeat as XFeatPipeline
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor, nn
from torch.nn import functional

from thegra_core.config import ExtractorConfig
from thegra_core.features.assemble import described, scaled_image, selected
from thegra_core.features.backends import Compiled, Replaced, chosen, export, exported_path
from thegra_core.features.checkpoint import load_checkpoint, load_exactly
from thegra_core.features.corners import corners
from thegra_core.features.detection import strict_maxima
from thegra_core.features.device import resolve_device
from thegra_core.features.flow import normalize_contrast
from thegra_core.messages import Features

_MULTIPLE = 32
NMS_RADIUS = 2
CANDIDATES = 4
"""Times as many detections as keypoints among which these are spread."""
SAME_PX = 3.0
"""px, of what the network sees, around a corner in which a detection is that corner's."""
OUTPUTS = ("features", "keypoints", "reliability")
"""Maps of the network, in its order."""


class XFeat:
    """`Extractor` with XFeat; keypoints are pixels of the image the network saw, with sides cut to multiples of 32 by resizing."""

    def __init__(self, config: ExtractorConfig) -> None:
        self.name: str = config.name
        self._config = config
        self._device = resolve_device(config.device)
        network = _network().to(self._device)
        runtime = chosen(config.backend, self._device)
        if runtime != "torch":
            network = Replaced(Compiled(network, "xfeat", OUTPUTS, runtime, torch.get_num_threads()))
        self._network = network
        self._beside = ThreadPoolExecutor(1, "thegra corners")

    @torch.inference_mode()
    def extract(self, image: NDArray[np.uint8], stamp_ns: int) -> Features:
        """See `Extractor.extract`. What is not chosen is not described: it takes as long as all the rest beside the network."""
        config, image_size = self._config, (image.shape[1], image.shape[0])
        scaled, scale = scaled_image(image, config.long_side)
        beside = self._beside.submit(_corners, image, config)  # it takes a fifth of the network's time
        grey = torch.from_numpy(np.ascontiguousarray(scaled)).to(self._device).float()[None, None] / 255
        size = (scaled.shape[1], scaled.shape[0])
        seen = network_size(size)
        grey = functional.interpolate(grey, seen[::-1], mode="bilinear", align_corners=False)
        descriptors, logits, reliability = (found.cpu() for found in self._network(grey))
        heat = _heat_map(logits)
        maxima = strict_maxima(heat[0, 0].numpy(), NMS_RADIUS, config.detection_threshold)
        pixels = torch.from_numpy(maxima)
        scores = (_sampled(heat, pixels, seen, "nearest") * _sampled(reliability, pixels, seen, "bilinear"))[:, 0].numpy()
        strongest = np.argsort(-scores, kind="stable")[: CANDIDATES * config.max_keypoints]
        strongest = strongest[scores[strongest] > 0]
        maxima, scores = maxima[strongest], scores[strongest]
        ratio = np.asarray(size) / np.asarray(seen)
        places, scores = _behind((beside.result() + 0.5) * scale / ratio - 0.5, maxima, scores)
        raw, rows = selected(config, image_size, scale, (places + 0.5) * ratio - 0.5, scores, np.ones(len(scores), bool))
        vectors = _sampled(functional.normalize(descriptors, dim=1), torch.from_numpy(places[rows]), seen, "bicubic")
        return described(config, stamp_ns, image_size, raw, scores[rows], functional.normalize(vectors, dim=-1).numpy())


def _corners(image: NDArray[np.uint8], config: ExtractorConfig) -> NDArray[np.float64]:
    return corners(normalize_contrast(image), config.corners, config.border) if config.corners else np.empty((0, 2))


def _behind(found: NDArray[np.float64], maxima: NDArray[np.int64], scores: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Corners (C, 2), strongest first, and behind them the detections (N, 2) that are not theirs, all in pixels of what the network saw; with scores: the corners
    by their order, each better than any detection."""
    if len(found) == 0:
        return maxima.astype(np.float64), scores
    if len(maxima):
        away = cKDTree(found).query(maxima)[0] > SAME_PX
        maxima, scores = maxima[away], scores[away]
    order = 1 - np.arange(len(found), dtype=np.float32) / (2 * len(found))
    return np.concatenate((found, maxima)), np.concatenate((order, 0.5 * scores / scores.max() if len(scores) else scores))


def _network() -> nn.Module:
    """The network that makes the maps, with its weights.

    Raises:
        WeightsError: If they are not in the cache.
    """
    network: nn.Module = XFeatPipeline().net
    load_exactly(network, load_checkpoint("xfeat"), "xfeat")
    return network.eval()


def _heat_map(logits: Tensor) -> Tensor:
    """(1, 1, 8 H, 8 W) probability of a keypoint from (1, 65, H, W): each cell's 64 pixels, and one for none of them."""
    height, width = logits.shape[2:]
    cells = functional.softmax(logits, 1)[:, :64].permute(0, 2, 3, 1).reshape(1, height, width, 8, 8)
    return cells.permute(0, 1, 3, 2, 4).reshape(1, 1, 8 * height, 8 * width)


def _sampled(values: Tensor, pixels: Tensor, size: tuple[int, int], mode: str) -> Tensor:
    """(N, C) of a map (1, C, h, w) at pixels (N, 2) of an image of `size` (width, height), where the weights were trained to look: half a pixel beside its centre."""
    grid = 2.0 * pixels.float() / (torch.tensor(size) - 1) - 1.0
    return functional.grid_sample(values, grid[None, :, None], mode=mode, align_corners=False)[0, :, :, 0].T


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
    export(_network(), network_size(image_size), OUTPUTS, path)
    return path
