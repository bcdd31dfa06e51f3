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


class PlaceIndex:
    """Keyframes by their image's vector. The vocabulary is learnt from the first keyframes of the map; until then nothing is found."""

    def __init__(self, config: LoopConfig, seed: int) -> None:
        self._config = config
        self._seed = seed
        self._waiting: dict[int, Features] = {}
        self._vocabulary: FloatArray | None = None
        self._rows: dict[int, int] = {}
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

    def similarity(self, keyframe_id: int) -> dict[int, float]:
        """Cosine of every keyframe's vector with that of one of them; empty while there is no vocabulary."""
        if keyframe_id not in self._rows:
            return {}
        known = self._vectors[: len(self._rows)]
        return dict(zip(self._rows, (known @ known[self._rows[keyframe_id]]).tolist(), strict=True))

    def query(self, features: Features, most: int) -> list[int]:
        """At most `most` keyframes that look most like an image that is none of them, the most similar first."""
        similar = self._similar(features)
        return sorted(similar, key=lambda i: (-similar[i], i))[:most]

    def alike(self, features: Features, near: Sequence[Features]) -> list[int]:
        """Keyframes that look nearly as much like an image that is none of them as the images `near` it do, the most similar first."""
        if self._vocabulary is None or not near:
            return []
        vector = describe(features, self._vocabulary)
        bar = self._config.similarity_share * float(np.median([vector @ describe(other, self._vocabulary) for other in near]))
        similar = self._similar(features)
        return sorted((i for i, value in similar.items() if value >= bar), key=lambda i: (-similar[i], i))

    def arrays(self) -> Arrays:
        """Words and vectors for a map file; nothing before there are words."""
        if self._vocabulary is None:
            return {}
        return {"vocabulary": self._vocabulary, "ids": np.array(list(self._rows), dtype=np.int64), "vectors": self._vectors[: len(self._rows)]}

    def restore(self, arrays: Arrays, features: Mapping[int, Features]) -> None:
        """Take what `arrays` gave, of the keyframes whose features are given by id."""
        if not arrays:
            for keyframe_id, those in features.items():
                self.add(keyframe_id, those)
            return
        self._waiting.clear()
        self._vocabulary, self._vectors = arrays["vocabulary"], arrays["vectors"]
        self._rows = {keyframe_id: row for row, keyframe_id in enumerate(arrays["ids"].tolist())}

    def candidates(self, keyframe_id: int, connected: Sequence[int]) -> list[int]:
        """Keyframes that look nearly as much like this one as those do that see the same, the most similar first.

        connected: ids that are no news, those that share most with it first; the first five set the bar.
        """
        similar = self.similarity(keyframe_id)
        near = [similar[i] for i in connected if i in similar and i != keyframe_id][:5]
        if not near:
            return []
        bar = self._config.similarity_share * float(np.median(near))
        found = [(value, i) for i, value in similar.items() if value >= bar and i != keyframe_id and i not in connected]
        return [i for _, i in sorted(found, reverse=True)]

    def _similar(self, features: Features) -> dict[int, float]:
        if self._vocabulary is None:
            return {}
        return dict(zip(self._rows, (self._vectors[: len(self._rows)] @ describe(features, self._vocabulary)).tolist(), strict=True))

    def _append(self, keyframe_id: int, features: Features) -> None:
        assert self._vocabulary is not None
        vector = describe(features, self._vocabulary)
        count = len(self._rows)
        if count == len(self._vectors):
            grown = np.zeros((max(64, 2 * count), len(vector)), np.float32)
            if count:
                grown[:count] = self._vectors
            self._vectors = grown
        self._vectors[count] = vector
        self._rows[keyframe_id] = count
