"""Mutual nearest neighbours with the ratio test (Lowe 2004), on float descriptors by angle and on binary ones by Hamming distance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import MatcherConfig
from thegra_core.errors import ConfigError
from thegra_core.messages import Features, Matches


class Nearest:
    """`Matcher` without a network."""

    def __init__(self, config: MatcherConfig) -> None:
        self.name = "nearest"
        self._ratio = config.ratio

    def match(self, query: Features, reference: Features) -> Matches:
        """See `Matcher.match`; the confidence is the similarity of the descriptors (cosine, or share of equal bits)."""
        if query.extractor != reference.extractor:
            raise ConfigError(f"features of {query.extractor} cannot be matched with features of {reference.extractor}")
        if len(query) == 0 or len(reference) == 0:
            return Matches(query.stamp_ns, reference.stamp_ns, np.empty((0, 2), np.int32), np.empty(0, np.float32))
        distances, largest = _distances(query.descriptors, reference.descriptors)
        indices, nearest = _mutual(distances, self._ratio)
        confidence = 1 - nearest ** (2 if largest is None else 1) / (largest or 2.0)
        return Matches(query.stamp_ns, reference.stamp_ns, indices, np.clip(confidence, 0, 1).astype(np.float32))

    def match_many(self, query: Features, references: Sequence[Features]) -> list[Matches]:
        """See `Matcher.match_many`."""
        return [self.match(query, reference) for reference in references]


def _distances(
    query: NDArray[np.float32] | NDArray[np.uint8], reference: NDArray[np.float32] | NDArray[np.uint8]
) -> tuple[NDArray[np.float32], float | None]:
    """(N, M) Euclidean distances of unit vectors and None, or Hamming distances and the number of bits."""
    if query.dtype == np.uint8:
        bits = 8.0 * query.shape[1]
        return np.asarray((bits - _signs(query) @ _signs(reference).T) / 2, np.float32), bits
    products = np.asarray(query, np.float32) @ np.asarray(reference, np.float32).T
    products *= -2
    products += 2
    return np.sqrt(np.maximum(products, 0, out=products), out=products), None


def _mutual(distances: NDArray[np.float32], ratio: float) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Pairs (M, 2) that are nearest to each other and clearly nearer than the query's second nearest, and their distances (M,); `distances` are used up."""
    rows = np.arange(len(distances))
    best = distances.argmin(axis=1)
    mutual = distances.argmin(axis=0)[best] == rows
    nearest = distances[rows, best]
    if distances.shape[1] > 1 and ratio < 1:
        distances[rows, best] = np.inf
        mutual &= nearest < ratio * distances.min(axis=1)
    return np.stack((rows[mutual], best[mutual]), axis=1).astype(np.int32), nearest[mutual]


def _signs(binary: NDArray[np.float32] | NDArray[np.uint8]) -> NDArray[np.float32]:
    """Bits as -1 and 1: their products count equal bits less unequal ones, exactly."""
    return np.unpackbits(np.asarray(binary, np.uint8), axis=1).astype(np.float32) * 2 - 1
