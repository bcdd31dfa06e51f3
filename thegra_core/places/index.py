"""The places of a map, found again by what they look like."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from thegra_core.config import LoopConfig
from thegra_core.map.archive import Arrays
from thegra_core.messages import Features
from thegra_core.places.descriptor import describe, learn_vocabulary

FloatArray = NDArray[np.float32]

NEAR = 5
"""Images of the same place that say how alike two images of it are."""


class PlaceIndex:
    """Keyframes by their image's vector. The vocabulary is learnt from the first keyframes of the map; until then nothing is found."""

    def __init__(self, config: LoopConfig, seed: int) -> None:
        self._config = config
        self._seed = seed
        self._waiting: dict[int, Features] = {}
        self._vocabulary: FloatArray | None = None
        self._rows: dict[int, int] = {}
        self._ids: list[int] = []
        self._vectors = np.empty((0, 0), np.float32)

    def add(self, keyframe_id: int, features: Features) -> None:
        """Take a keyframe."""
        if self._vocabulary is None:
            self._waiting[keyframe_id] = features
            if len(self._waiting) < self._config.vocabulary_keyframes or sum(map(len, self._waiting.values())) < self._config.words:
                return
            self._vocabulary = learn_vocabulary(list(self._waiting.values()), self._config.words, self._seed)
            for waiting_id, waiting in self._waiting.items():
                self._append(waiting_id, waiting)
            self._waiting.clear()
            return
        self._append(keyframe_id, features)

    def remove(self, keyframe_id: int) -> None:
        """Forget a keyframe, if it is there."""
        self._waiting.pop(keyframe_id, None)
        row = self._rows.pop(keyframe_id, None)
        if row is None:
            return
        last = self._ids.pop()
        if last != keyframe_id:
            self._vectors[row] = self._vectors[len(self._ids)]
            self._ids[row], self._rows[last] = last, row

    def query(self, features: Features, most: int) -> list[int]:
        """At most `most` keyframes that look most like an image that is none of them, the most similar first."""
        if self._vocabulary is None:
            return []
        return _ranked(self._similar(describe(features, self._vocabulary)))[:most]

    def alike(self, features: Features, near: Sequence[Features]) -> list[int]:
        """Keyframes that look nearly as much like an image that is none of them as the first images of `near` it do, the most similar first."""
        if self._vocabulary is None:
            return []
        vector = describe(features, self._vocabulary)
        return self._above_bar(self._similar(vector), [float(vector @ describe(other, self._vocabulary)) for other in near[:NEAR]])

    def candidates(self, keyframe_id: int, connected: Sequence[int]) -> list[int]:
        """Keyframes that look nearly as much like this one as those do that see the same, the most similar first.

        connected: ids that are no news, those that share most with it first.
        """
        if keyframe_id not in self._rows:
            return []
        similar = self._similar(self._vectors[self._rows[keyframe_id]])
        del similar[keyframe_id]
        near = [similar.pop(i) for i in connected if i in similar]
        return self._above_bar(similar, near[:NEAR])

    def arrays(self) -> Arrays:
        """Words and vectors for a map file; nothing before there are words."""
        if self._vocabulary is None:
            return {}
        return {"vocabulary": self._vocabulary, "ids": np.array(self._ids, dtype=np.int64), "vectors": self._vectors[: len(self._ids)]}

    def restore(self, arrays: Arrays, features: Mapping[int, Features]) -> None:
        """Take what `arrays` gave, of the keyframes whose features are given by id."""
        if not arrays:
            for keyframe_id, those in features.items():
                self.add(keyframe_id, those)
            return
        self._waiting.clear()
        self._vocabulary, self._vectors = arrays["vocabulary"], arrays["vectors"]
        self._ids = arrays["ids"].tolist()
        self._rows = {keyframe_id: row for row, keyframe_id in enumerate(self._ids)}

    def _similar(self, vector: FloatArray) -> dict[int, float]:
        """Cosine of every keyframe's vector with a vector."""
        return dict(zip(self._ids, (self._vectors[: len(self._ids)] @ vector).tolist(), strict=True))

    def _above_bar(self, similar: dict[int, float], near: list[float]) -> list[int]:
        if not near:
            return []
        bar = self._config.similarity_share * float(np.median(near))
        return _ranked({i: value for i, value in similar.items() if value >= bar})

    def _append(self, keyframe_id: int, features: Features) -> None:
        assert self._vocabulary is not None
        vector = describe(features, self._vocabulary)
        count = len(self._ids)
        if count == len(self._vectors):
            grown = np.zeros((max(64, 2 * count), len(vector)), np.float32)
            if count:
                grown[:count] = self._vectors
            self._vectors = grown
        self._vectors[count] = vector
        self._rows[keyframe_id] = count
        self._ids.append(keyframe_id)


def _ranked(similar: dict[int, float]) -> list[int]:
    return sorted(similar, key=lambda i: (-similar[i], i))
