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
    nearby: the camera was at these keyframes just now, and a pose that tracking would take will do, see `doubt_nearby`. A camera that may be anywhere sees much
    that looks alike, such as the cars and windows of another street: see `doubt_of`.
    """
    matched = dict(known or {})
    open_ids = [i for i in candidates if i not in matched]
    matched.update(zip(open_ids, matcher.match_many(features, [current.keyframes[i].features for i in open_ids]), strict=True))
    if not matched:
        return None
    reference_id = max(matched, key=lambda i: (len(matched[i]), i))
    found = localize(current, features, reference_id, matched, None, config)
    if isinstance(found, str):
        return None
    reference_id = best_reference(current, found.landmark_ids, list(matched))
    doubt = (doubt_nearby if nearby else doubt_of)(current, found, reference_id, config)
    if doubt:
        logger.info("the frame at %.3f s looks like keyframe %d: %s", features.stamp_ns / 1e9, reference_id, doubt)
        return None
    return found, reference_id, matched[reference_id]


def doubt_of(current: Map, found: Localization, reference_id: int, config: ThegraConfig) -> str:
    """Why a pose of a camera that may be anywhere is not believed, by the keyframe that shares most with it; empty if it is."""
    settings = config.relocalization
    if found.inliers < settings.min_inliers:
        return f"{found.inliers} landmarks agree with one pose"
    return _too_few_of(*evidence(current, found, reference_id, config), settings.min_visible_share)


def doubt_nearby(current: Map, found: Localization, reference_id: int, config: ThegraConfig) -> str:
    """As `doubt_of`, for a camera that was there just now: the view may all the same have jumped to a place that looks alike. What few landmarks and many other
    matches have placed (`localize_sparsely`) has had a proof of its own."""
    settings = config.tracking
    return "" if found.inliers < settings.min_inliers else _too_few_of(*evidence(current, found, reference_id, config), settings.min_visible_share)


def _too_few_of(agreeing: int, visible: int, share: float) -> str:
    return f"{agreeing} landmarks agree with one pose, {visible} should be seen from there" if agreeing < share * visible else ""


def evidence(current: Map, found: Localization, reference_id: int, config: ThegraConfig) -> tuple[int, int]:
    """How many of a keyframe's landmarks a frame sees, and how many it should see from its pose."""
    visible = should_be_seen(current, [reference_id], found.camera_from_world, config.tracking)
    return int(np.isin(visible, found.landmark_ids).sum()), len(visible)


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
