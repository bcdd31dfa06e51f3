"""Finding the pose again: a frame against several keyframes of a map."""

from __future__ import annotations

from thegra_core.config import ThegraConfig
from thegra_core.features.protocols import Matcher
from thegra_core.map.map import Map
from thegra_core.messages import Features, Matches
from thegra_core.tracking.tracker import Localization, localize


def relocalize(
    current: Map, features: Features, candidates: list[int], matcher: Matcher, config: ThegraConfig, min_inliers: int
) -> tuple[Localization, int, Matches] | None:
    """The first candidate keyframe in which the frame is placed with at least `min_inliers`; also its id and the matches to it."""
    for keyframe_id in candidates:
        matches = matcher.match(features, current.keyframes[keyframe_id].features)
        found = localize(current, features, keyframe_id, matches, None, config)
        if isinstance(found, Localization) and found.inliers >= min_inliers:
            return found, keyframe_id, matches
    return None


def last_keyframes(current: Map, reference_id: int, count: int) -> list[int]:
    """At most `count` ids: the newest keyframes and the reference's best neighbours in turn, without the reference itself, which tracking has tried."""
    newest = sorted(current.keyframes, reverse=True)
    covisible = current.neighbours(reference_id, count)
    ordered = [i for pair in zip(newest, [*covisible, *newest[len(covisible) :]], strict=False) for i in pair]
    return [i for i in dict.fromkeys(ordered) if i != reference_id][:count]


def nearest_in_time(current: Map, stamp_ns: int, count: int) -> list[int]:
    """Ids of the `count` keyframes whose stamps are nearest."""
    return sorted(current.keyframes, key=lambda i: (abs(current.keyframes[i].stamp_ns - stamp_ns), i))[:count]
