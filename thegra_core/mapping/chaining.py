"""Matches through a common neighbour: what two keyframes share is known without a network where both were matched to a third."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from thegra_core.map.archive import Arrays
from thegra_core.map.file import offsets
from thegra_core.messages import Matches

IntArray = NDArray[np.int64]


class MatchGraph:
    """All matches made between a map's keyframes, in both directions."""

    def __init__(self) -> None:
        self._edges: dict[int, dict[int, Matches]] = {}

    def add(self, keyframe_id: int, other_id: int, matches: Matches) -> None:
        """Keep matches whose queries are the keypoints of `keyframe_id` and whose references are those of `other_id`."""
        self._edges.setdefault(keyframe_id, {})[other_id] = matches
        self._edges.setdefault(other_id, {})[keyframe_id] = reversed_matches(matches)

    def remove(self, keyframe_id: int) -> None:
        """Forget a keyframe's matches."""
        for other in self._edges.pop(keyframe_id, {}):
            del self._edges[other][keyframe_id]

    def absorb(self, other: MatchGraph) -> None:
        """Take in the matches between other keyframes."""
        self._edges.update(other._edges)

    def arrays(self) -> Arrays:
        """All matches for a map file: one row of `edges` (keyframe, other) and one stretch of `indices` and `confidence` a pair."""
        edges = [(i, other) for i in sorted(self._edges) for other in sorted(self._edges[i]) if i > other]
        matches = [self._edges[i][other] for i, other in edges]
        return {
            "edges": np.array(edges, dtype=np.int64).reshape(-1, 2),
            "offsets": offsets([len(m) for m in matches]),
            "indices": np.concatenate([np.empty((0, 2), np.int32), *(m.indices for m in matches)]),
            "confidence": np.concatenate([np.empty(0, np.float32), *(m.confidence for m in matches)]),
        }

    @classmethod
    def restored(cls, arrays: Arrays, stamps_ns: Mapping[int, int]) -> MatchGraph:
        """The graph of `arrays`; `stamps_ns` by keyframe id."""
        graph = cls()
        bounds = arrays["offsets"].tolist()
        for row, (keyframe_id, other) in enumerate(arrays["edges"].tolist()):
            mine = slice(bounds[row], bounds[row + 1])
            graph.add(keyframe_id, other, Matches(stamps_ns[keyframe_id], stamps_ns[other], arrays["indices"][mine], arrays["confidence"][mine]))
        return graph

    def chained(self, keyframe_id: int, most: int) -> list[tuple[int, Matches]]:
        """Keyframes two matches away from a keyframe, with the matches that follow; at most `most`, those with most matches first."""
        direct = self._edges.get(keyframe_id, {})
        paths: dict[int, list[Matches]] = {}
        for middle, first in direct.items():
            for far, second in self._edges[middle].items():
                if far != keyframe_id and far not in direct:
                    paths.setdefault(far, []).append(compose(first, second))
        joined = [(far, join(parts)) for far, parts in paths.items()]
        return sorted((item for item in joined if len(item[1])), key=lambda item: (-len(item[1]), -item[0]))[:most]


def reversed_matches(matches: Matches) -> Matches:
    """Query and reference exchanged, in the order of the new queries."""
    order = np.argsort(matches.indices[:, 1], kind="stable")
    return Matches(matches.reference_stamp_ns, matches.stamp_ns, np.ascontiguousarray(matches.indices[order, ::-1]), matches.confidence[order])


def compose(first: Matches, second: Matches) -> Matches:
    """Matches a to c from those of a to b and of b to c; a chain is as sure as both its links together."""
    size = 1 + max(int(first.indices[:, 1].max(initial=-1)), int(second.indices[:, 0].max(initial=-1)))
    row_of = np.full(size, -1, dtype=np.int64)
    row_of[second.indices[:, 0]] = np.arange(len(second))
    rows = row_of[first.indices[:, 1]]
    use = rows >= 0
    indices = np.stack((first.indices[use, 0], second.indices[rows[use], 1]), axis=1)
    return Matches(first.stamp_ns, second.reference_stamp_ns, indices, first.confidence[use] * second.confidence[rows[use]])


def join(parts: Iterable[Matches]) -> Matches:
    """One-to-one matches of the same two frames from several sources, the more confident ones first, in the order of the queries."""
    chosen = list(parts)
    indices = np.concatenate([p.indices for p in chosen])
    confidence = np.concatenate([p.confidence for p in chosen])
    order = np.argsort(-confidence, kind="stable")
    for column in (0, 1):
        order = order[np.sort(np.unique(indices[order, column], return_index=True)[1])]
    order = order[np.argsort(indices[order, 0], kind="stable")]
    return Matches(chosen[0].stamp_ns, chosen[0].reference_stamp_ns, indices[order], confidence[order])
