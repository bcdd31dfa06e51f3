"""Maps of the same world: a keyframe of the newer one that sees what the older one saw ties them together, and they become one."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field

from thegra_core.config import ThegraConfig
from thegra_core.features.protocols import Matcher
from thegra_core.geometry.similarity import Similarity
from thegra_core.map.editor import MapEditor
from thegra_core.map.map import Map
from thegra_core.mapping.loop_closing import ESSENTIAL_NEIGHBOURS, adjust_both_sides, fuse_sighting
from thegra_core.messages import Revisit
from thegra_core.places.index import NEAR, PlaceIndex
from thegra_core.places.verification import Sighting, agree, sight

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Tie:
    """Two keyframes of a map that place it alike in another one."""

    old_map_id: int
    sightings: tuple[Sighting, Sighting]

    def old_from_new(self, new: Map) -> Similarity:
        """The old map's world from the new one's."""
        last = self.sightings[-1]
        return last.world_from_camera @ Similarity(new.keyframes[last.keyframe_id].world_from_camera).inverse()


@dataclass
class MapMerger:
    """Looks for one map's keyframes in the others. A tie takes two keyframes in a row, as a loop does."""

    config: ThegraConfig
    matcher: Matcher
    _waiting: dict[int, Sighting] = field(default_factory=dict)

    def find(self, new: Map, keyframe_id: int, others: Mapping[int, tuple[Map, PlaceIndex]]) -> Tie | None:
        """A tie of the keyframe's map to one of the others, if this keyframe and the one before it make one."""
        keyframe = new.keyframes[keyframe_id]
        before = {map_id: found for map_id, found in self._waiting.items() if found.keyframe_id in new.keyframes}
        self._waiting = {}
        near = [new.keyframes[i].features for i in new.neighbours(keyframe_id, NEAR)] if others else []
        for map_id, (old, index) in sorted(others.items()):
            for candidate in index.alike(keyframe.features, near)[:1]:
                found = sight(new, keyframe_id, old, [candidate, *old.neighbours(candidate, self.config.loop.group - 1)], self.matcher, self.config)
                if isinstance(found, str):
                    logger.debug("keyframe %d looks like %d of map %d: %s", keyframe_id, candidate, map_id, found)
                    continue
                if map_id in before and agree(new, before[map_id], found, self.config):
                    return Tie(map_id, (before[map_id], found))
                self._waiting[map_id] = found
        return None


def merge(old: MapEditor, new: MapEditor, tie: Tie, config: ThegraConfig) -> dict[int, int]:
    """Make the new map part of the old one, which is adjusted where they meet; returns the new ids of the new map's landmarks."""
    old_from_new = tie.old_from_new(new.map)
    renamed = old.absorb(new, old_from_new)
    for sighting in tie.sightings:
        fuse_sighting(old, sighting)
    concerned = {i for sighting in tie.sightings for i in (sighting.keyframe_id, *sighting.matches)}
    for keyframe_id in sorted(concerned | {n for i in concerned for n in old.map.neighbours(i, ESSENTIAL_NEIGHBOURS)}):
        old.connect(keyframe_id)
    adjust_both_sides(old, tie.sightings[-1], config)
    last, (theirs, ours) = tie.sightings[-1], (new.map.map_id, old.map.map_id)
    stamp_ns = old.map.keyframes[last.keyframe_id].stamp_ns
    old.note(Revisit(stamp_ns, ours, last.keyframe_id, next(iter(last.matches)), len(last.keypoints), 0.0, old_from_new.scale, theirs))
    logger.info("map %d is part of map %d: keyframe %d sees the same by %d landmarks of %d that should be seen", theirs, ours, last.keyframe_id, len(last.keypoints), last.visible)
    return renamed
