"""Images turned by quarter turns before anything is looked for in them: learned features know up from down, and a camera that looks at the ground turns round.

A turned image does not show the same keypoints as the upright one: a corner of a tree's crown is another corner then. So a frame's features are those of one
orientation, chosen so that they look like the map; what is told of them, their pixels above all, is upright all the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thegra_core.features.protocols import Extractor, Matcher
from thegra_core.messages import Features, Float32Array, Matches


def turned_features(image: NDArray[np.uint8], stamp_ns: int, turns: int, extractor: Extractor) -> Features:
    """What the extractor finds in an image (H, W) turned counter-clockwise by quarter turns, at upright pixels."""
    if turns % 4 == 0:
        return extractor.extract(image, stamp_ns)
    found = extractor.extract(np.ascontiguousarray(np.rot90(image, turns)), stamp_ns)
    return replace(found, keypoints=turned_pixels(found.keypoints, -turns, found.image_size), image_size=_size(found.image_size, turns), turns=turns % 4)


def turned_pixels(pixels: Float32Array, turns: int, image_size: tuple[int, int]) -> Float32Array:
    """Where pixels (N, 2) of an image of `image_size` (width, height) are when it is turned counter-clockwise by quarter turns."""
    width, height = image_size
    x, y = pixels[:, 0], pixels[:, 1]
    turned = ((x, y), (y, width - 1 - x), (width - 1 - x, height - 1 - y), (height - 1 - y, x))[turns % 4]
    return np.ascontiguousarray(np.stack(turned, axis=1))


class TurnableExtractor:
    """`Extractor` of images that are turned by `turns` quarter turns, which may change from image to image."""

    def __init__(self, inner: Extractor) -> None:
        self._inner = inner
        self.turns = 0

    @property
    def name(self) -> str:
        return self._inner.name

    def extract(self, image: NDArray[np.uint8], stamp_ns: int) -> Features:
        """See `Extractor.extract`."""
        return self.turned(image, stamp_ns, 0)

    def turned(self, image: NDArray[np.uint8], stamp_ns: int, further: int) -> Features:
        """What is found in an image (H, W) turned by `further` quarter turns beyond `turns`."""
        return turned_features(image, stamp_ns, (self.turns + further) % 4, self._inner)


class TurningMatcher:
    """`Matcher` that shows another one the features of each image as they were found, in the turned image."""

    def __init__(self, inner: Matcher) -> None:
        self.name = inner.name
        self._inner = inner

    def match(self, query: Features, reference: Features) -> Matches:
        """See `Matcher.match`."""
        return self._inner.match(_as_found(query), _as_found(reference))

    def match_many(self, query: Features, references: Sequence[Features]) -> list[Matches]:
        """See `Matcher.match_many`."""
        return self._inner.match_many(_as_found(query), [_as_found(reference) for reference in references])


def _as_found(features: Features) -> Features:
    if features.turns == 0:
        return features
    pixels = turned_pixels(features.keypoints, features.turns, features.image_size)
    return replace(features, keypoints=pixels, image_size=_size(features.image_size, features.turns), turns=0)


def _size(image_size: tuple[int, int], turns: int) -> tuple[int, int]:
    width, height = image_size
    return (height, width) if turns % 2 else (width, height)
