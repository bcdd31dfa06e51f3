"""Finding the pose again: a frame against several keyframes of a map."""

from __future__ import annotations

import logging
from collections.abc import Mapping

import numpy as np

from thegra_core.config import ThegraConfig
from thegra_core.features.protocols import Matcher
from thegra_core.map.map import Map
from thegra_core.messages import Features, Matches
from thegra_core.places.index import PlaceIndex
from thegra_core.places.verification import should_be_seen
from thegra_core.tracking.tracker import Localization, best_reference, localize

logger = logging.getLogger(__name__)


def relocalize(
    current: Map, features: Features, candidates: list[int], matcher: Matcher, config: ThegraConfig, nearby: bool, known: Mapping[int, Matches] | None = None
) -> tuple[Localization, int, Matches] | None:
    """Place the frame by its matches to all candidate keyframes together; also the keyframe that shares most with it and the matches to that one.

    One keyframe alone may share too little with a frame that comes back after a gap; what several share adds up. `known` matches are not made again.
    nearby: the camera was at these keyframes just now, so that less evidence will do. From anywhere, streets and rooms have much that looks alike (cars,
    windows): a pose is taken only where it shows enough of what should be seen from there.
    """
    least = config.tracking if nearby else config.relocalization
    matched = dict(known or {})
    open_ids = [i for i in candidates if i not in matched]
    matched.update(zip(open_ids, matcher.match_many(features, [current.keyframes[i].features for i in open_ids]), strict=True))
    if not matched:
        return None
    reference_id = max(matched, key=lambda i: (len(matched[i]), i))
    found = localize(current, features, reference_id, matched, None, config)
    if isinstance(found, str) or found.inliers < least.min_inliers:
        return None
    reference_id = best_reference(current, found.landmark_ids, list(matched))
    if not nearby:
        visible = should_be_seen(current, [reference_id], found.camera_from_world, config.tracking)
        agreeing = int(np.isin(visible, found.landmark_ids).sum())
        if agreeing < config.relocalization.min_visible_share * len(visible):
            told = "the frame at %.3f s looks like keyframe %d: %d of its landmarks agree with one pose, %d should be seen from there"
            logger.info(told, features.stamp_ns / 1e9, reference_id, agreeing, len(visible))
            return None
    return found, reference_id, matched[reference_id]


def last_keyframes(current: Map, reference_id: int, count: int) -> list[int]:
    """At most `count` ids: the newest keyframes and the reference's best neighbours in turn, without the reference itself, which tracking has tried."""
    newest = sorted(current.keyframes, reverse=True)
    covisible = current.neighbours(reference_id, count)
    ordered = [i for pair in zip(newest, [*covisible, *newest[len(covisible) :]], strict=False) for i in pair]
    return [i for i in dict.fromkeys(ordered) if i != reference_id][:count]


def similar_keyframes(current: Map, places: PlaceIndex, features: Features, reference_id: int, count: int) -> list[int]:
    """At most `count` ids: the keyframe that looks most like the frame, the best neighbour of it, then the next that look alike; newest while there are no words.

    The reference is left out, which tracking has tried.
    """
    alike = places.query(features, count + 1)
    if not alike:
        return last_keyframes(current, reference_id, count)
    ordered = [alike[0], *current.neighbours(alike[0], 1), *alike[1:]]
    return [i for i in dict.fromkeys(ordered) if i != reference_id and i in current.keyframes][:count]


def nearest_in_time(current: Map, stamp_ns: int, count: int) -> list[int]:
    """Ids of the `count` keyframes whose stamps are nearest."""
    return sorted(current.keyframes, key=lambda i: (abs(current.keyframes[i].stamp_ns - stamp_ns), i))[:count]
