"""One vector for what a whole image shows, from the local descriptors that are there anyway (VLAD, Jegou et al. 2010)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thegra_core.messages import Features

FloatArray = NDArray[np.float32]

_ROUNDS = 10


def learn_vocabulary(images: list[Features], words: int, seed: int) -> FloatArray:
    """Words (words, D): the centres of the descriptors of some images, by k-means from seeded starts.

    Words of the very scene that is being mapped tell its places apart better than any that ship, for every descriptor and every sensor.
    """
    descriptors = np.concatenate([as_vectors(features) for features in images])
    rng = np.random.default_rng(seed)
    centres = descriptors[rng.choice(len(descriptors), words, replace=len(descriptors) < words)].copy()
    for _ in range(_ROUNDS):
        nearest = _nearest(descriptors, centres)
        for word in range(words):
            mine = descriptors[nearest == word]
            if len(mine):
                centres[word] = mine.mean(axis=0)
    return centres


def describe(features: Features, vocabulary: FloatArray) -> FloatArray:
    """Unit vector (words * D,) of an image: per word the sum of what its descriptors differ from it, each normalised, with roots of the entries."""
    descriptors = as_vectors(features)
    total = np.zeros_like(vocabulary)
    if len(descriptors):
        nearest = _nearest(descriptors, vocabulary)
        member = (nearest == np.arange(len(vocabulary))[:, None]).astype(np.float32)
        total = member @ descriptors - member.sum(axis=1, keepdims=True) * vocabulary
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    vector = np.sign(total) * np.sqrt(np.abs(total))
    return np.asarray(vector.ravel() / max(float(np.linalg.norm(vector)), 1e-12), dtype=np.float32)


def _nearest(descriptors: FloatArray, centres: FloatArray) -> NDArray[np.int64]:
    return np.asarray(np.argmax(descriptors @ centres.T - 0.5 * (centres**2).sum(axis=1), axis=1))


def as_vectors(features: Features) -> FloatArray:
    """Descriptors as unit vectors (N, D); bits become -1 and 1."""
    if features.descriptors.dtype != np.uint8:
        return np.asarray(features.descriptors, dtype=np.float32)
    bits = 2.0 * np.unpackbits(np.asarray(features.descriptors, dtype=np.uint8), axis=1).astype(np.float32) - 1.0
    return np.asarray(bits / np.sqrt(bits.shape[1]), dtype=np.float32)
