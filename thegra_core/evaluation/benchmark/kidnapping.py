"""A camera that is set down somewhere: whether it is found in a map of the place, and in no map of another one.

A map is made of every other frame of a clip. Then the camera sees frames that the map has not: of its own place it must find out where it is, between the
poses of the frames before and after; of another place it must find nothing, as long as it looks.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thegra_core.evaluation.benchmark.settings import Settings
from thegra_core.messages import Frame, TrackingResult, TrackingState
from thegra_core.slam import Slam
from thegra_core.sources.joined import Clip, common_camera

FloatArray = NDArray[np.float64]

AWAY_NS = 3_000_000_000
"""From the last frame of the map to the first that is looked for."""
PATIENCE_FRAMES = 15
"""In which the camera must be found."""
EVERY = 2
"""Of the frames one is the map's."""
_TOLERANCE, _NEAR = 0.5, 0.05


@dataclass(frozen=True, slots=True)
class KnownPlace:
    """A map in a file, and where it has the frames of its clip: positions (3,) by the frame's place in the clip."""

    clip: Clip
    file: Path
    positions: Mapping[int, FloatArray]

    def unseen(self) -> list[int]:
        """Places in the clip of frames that the map has not seen, between two that it has placed."""
        return [i for i in range(1, len(self.clip.frames) - 1, EVERY) if i - 1 in self.positions and i + 1 in self.positions]

    def is_there(self, number: int, world_from_camera: FloatArray) -> bool:
        """Whether a pose is between those of the frames before and after a frame of the clip, in units of the map, whose scene is one deep at its start."""
        before, after = self.positions[number - 1], self.positions[number + 1]
        off = np.linalg.norm(world_from_camera[:3, 3] - 0.5 * (before + after))
        return bool(off < _TOLERANCE * np.linalg.norm(after - before) + _NEAR)


def known_place(clip: Clip, settings: Settings, file: Path) -> KnownPlace | None:
    """A map of every other frame of a clip; None if there came none of it."""
    slam = Slam(clip.camera, settings.config, settings.extractor, settings.matcher)
    numbers = {frame.stamp_ns: number for number, frame in enumerate(clip.frames)}
    for frame in clip.frames[::EVERY]:
        slam.process(frame)
    run = slam.finish()
    if not run.maps:
        return None
    slam.save_map(file)
    return KnownPlace(clip, file, {numbers[f.stamp_ns]: f.world_from_camera[:3, 3] for f in run.frames if f.world_from_camera is not None and f.map_id == run.main_map_id})


def set_down(place: KnownPlace, frames: Iterable[Frame], settings: Settings) -> Iterator[TrackingResult]:
    """What a camera makes of one frame after the other, at the pace of the place's clip, that knows nothing but the map, which stays as it is."""
    slam = Slam(place.clip.camera, settings.config, settings.extractor, settings.matcher)
    slam.load_map(place.file)
    slam.localization_only = True
    begin_ns, period_ns = place.clip.frames[-1].stamp_ns + AWAY_NS, place.clip.period_ns
    for i, frame in enumerate(frames):
        yield slam.process(replace(frame, stamp_ns=begin_ns + i * period_ns))


def kidnap(place: KnownPlace, trials: int, settings: Settings) -> list[bool | None]:
    """Set the camera down at frames of its own clip, drawn at random: whether it was found where it is, or elsewhere; None if it was not in time."""
    rng = np.random.default_rng(settings.config.seed)
    told: list[bool | None] = []
    for start in rng.choice(place.unseen(), trials).tolist():
        unseen = range(start, len(place.clip.frames) - 1, EVERY)[:PATIENCE_FRAMES]
        told.append(_first_found(place, unseen, settings))
    return told


def _first_found(place: KnownPlace, numbers: Sequence[int], settings: Settings) -> bool | None:
    for number, result in zip(numbers, set_down(place, (place.clip.frames[i] for i in numbers), settings), strict=False):
        if result.state is TrackingState.TRACKING and number - 1 in place.positions and number + 1 in place.positions:
            assert result.world_from_camera is not None
            return place.is_there(number, result.world_from_camera)
    return None


def benchmark(clips: Sequence[Clip], trials: int, shown: int, settings: Settings, say: Callable[[str], None]) -> Iterator[dict[str, Any]]:
    """Each clip's map, shown its own place and all others.

    Args:
        shown: Frames of each other clip that a map is shown, evenly spread.

    Yields:
        For each clip, under `map`: `found`, `elsewhere` and `lost` trials in its own place, and `claims`: by the name of another clip, the poses that were claimed
        there, each with the landmarks that agree and those that should have been seen. `found` is None where there came no map of it.
    """
    camera = common_camera([clip.camera for clip in clips])
    seen = [clip.seen_by(camera) for clip in clips]
    with tempfile.TemporaryDirectory() as folder:
        for clip in seen:
            say(f"a map of {clip.name}")
            place = known_place(clip, settings, Path(folder) / "place.map")
            if place is None:
                yield {"map": clip.name, "found": None, "elsewhere": 0, "lost": 0, "claims": {}}
                continue
            say(f"{clip.name} in its own map")
            told = kidnap(place, trials, settings)
            claims = {}
            for other in seen:
                if other.name != clip.name:
                    say(f"{other.name} in the map of {clip.name}")
                    claims[other.name] = _claims(place, _spread(other.frames, shown), settings)
            yield {"map": clip.name, "found": told.count(True), "elsewhere": told.count(False), "lost": told.count(None), "claims": claims}


def _claims(place: KnownPlace, frames: Sequence[Frame], settings: Settings) -> list[list[int]]:
    return [[r.inliers, r.visible] for r in set_down(place, frames, settings) if r.state is TrackingState.TRACKING]


def _spread(frames: Sequence[Frame], count: int) -> list[Frame]:
    return [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int)).tolist()]
