"""Matching of keypoints that were followed: their numbers say what is the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from thegra_core.features.protocols import Matcher
from thegra_core.messages import Features, IntArray, Matches


class TrackMatcher:
    """`Matcher` that pairs keypoints by the number of their track where two frames share `min_shared` tracks; where they do not, another matcher pairs the rest
    of those that are followed.

    min_shared None: tracks are never enough, the other matcher is always asked, and for all keypoints.
    """

    def __init__(self, matcher: Matcher, min_shared: int | None) -> None:
        self.name = matcher.name
        self._matcher = matcher
        self._min_shared = min_shared

    def match(self, query: Features, reference: Features) -> Matches:
        """See `Matcher.match`."""
        shared = shared_tracks(query, reference)
        if self._min_shared is None:
            return completed(shared, self._matcher.match(query, reference))
        if len(shared) >= self._min_shared:
            return shared
        rows = [followed_rows(features) for features in (query, reference)]
        found = self._matcher.match(only_followed(query), only_followed(reference))
        indices = np.stack([of[found.indices[:, side]] for side, of in enumerate(rows)], axis=1).astype(np.int32)
        return completed(shared, replace(found, indices=indices))

    def match_many(self, query: Features, references: Sequence[Features]) -> list[Matches]:
        """See `Matcher.match_many`."""
        return [self.match(query, reference) for reference in references]


def completed(first: Matches, second: Matches) -> Matches:
    """The first matches, and those of the second of the same two frames whose keypoints the first leave free."""
    if len(first) == 0 or len(second) == 0:
        return second if len(first) == 0 else first
    free = ~np.isin(second.indices[:, 0], first.indices[:, 0]) & ~np.isin(second.indices[:, 1], first.indices[:, 1])
    indices = np.concatenate((first.indices, second.indices[free]))
    order = np.argsort(indices[:, 0], kind="stable")
    return Matches(first.stamp_ns, first.reference_stamp_ns, indices[order], np.concatenate((first.confidence, second.confidence[free]))[order])


def followed_rows(features: Features) -> IntArray:
    """Rows (M,) of the keypoints that are followed; all where tracks are not told."""
    return np.arange(len(features)) if features.track_ids is None else np.flatnonzero(features.track_ids >= 0)


def only_followed(features: Features) -> Features:
    """The keypoints that are followed."""
    rows = followed_rows(features)
    return features if len(rows) == len(features) else features.chosen(rows)


def shared_tracks(query: Features, reference: Features) -> Matches:
    """Keypoints of the same track; none where either has no tracks."""
    if query.track_ids is None or reference.track_ids is None:
        return Matches(query.stamp_ns, reference.stamp_ns, np.empty((0, 2), np.int32), np.empty(0, np.float32))
    rows = [followed_rows(features) for features in (query, reference)]
    _, here, there = np.intersect1d(query.track_ids[rows[0]], reference.track_ids[rows[1]], assume_unique=True, return_indices=True)
    order = np.argsort(here)
    indices = np.stack((rows[0][here[order]], rows[1][there[order]]), axis=1).astype(np.int32)
    return Matches(query.stamp_ns, reference.stamp_ns, indices, np.ones(len(indices), np.float32))
