"""Where a camera may be that tracking could not place: the last keyframes, or once it is lost those of the whole map that look alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from thegra_core.config import ThegraConfig
from thegra_core.features.protocols import Matcher
from thegra_core.messages import Features, Matches
from thegra_core.tracking.place import Place
from thegra_core.tracking.relocalizer import last_keyframes, relocalize, similar_keyframes
from thegra_core.tracking.tracker import Localization


@dataclass(frozen=True, slots=True)
class Seeker:
    """Places frames by matching them to keyframes; by those of `thorough`, matchers that find more, the cheapest first, where there are any."""

    matcher: Matcher
    thorough: Sequence[Matcher]
    config: ThegraConfig

    def seek(self, place: Place, features: Features, matches: Matches) -> tuple[Localization, int, Matches] | None:
        """The frame's place, the keyframe by which it was found and the matches to that, or None; `matches` are to the reference."""
        settings = self.config.relocalization
        nearby = place.lost_frames == 0
        if nearby:
            candidates = last_keyframes(place.map, place.reference_id, settings.search_keyframes if place.search_frames else settings.keyframes)
        else:
            candidates = similar_keyframes(place.map, place.places, features, place.reference_id, settings.keyframes)
        if self.thorough:
            return self._thoroughly(place, features, [place.reference_id, *candidates][: settings.keyframes], nearby)
        return relocalize(place.map, features, candidates, self.matcher, self.config, nearby, {place.reference_id: matches})

    def _thoroughly(self, place: Place, features: Features, candidates: list[int], nearby: bool) -> tuple[Localization, int, Matches] | None:
        """Match a frame to the candidates; where the camera was just now to the first, and to the others only if that one is not enough: a slow matcher costs frames
        of a live camera. What may be anywhere is worth the matches to all."""
        first, others = candidates[0], candidates[1:]
        known: dict[int, Matches] = {}
        for matcher in self.thorough:
            known = {first: matcher.match(features, place.map.keyframes[first].features)}
            found = relocalize(place.map, features, [] if nearby else others, matcher, self.config, nearby, known)
            if found is not None:
                return found
        return relocalize(place.map, features, others, self.thorough[-1], self.config, nearby, known) if nearby else None
