"""Joined recordings: of different scenes, and of a scene with its own way back.

What belongs together is known from how a recording was joined, so no ground truth is needed: clips of different recordings must not share a map, and clips of
the same recording must share one, in which the same image is at the same place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from thegra_core.evaluation.benchmark.settings import Settings
from thegra_core.messages import FrameRecord, Run
from thegra_core.slam import Slam
from thegra_core.sources.joined import Clip, Joined, join

Kind = Literal["pairs", "back", "turned", "between"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""Two recordings, one after the other; one and its way back; one, the camera turned half round at its end, and the way back upside down; one, another one, and the
first one's way back."""
Way = Literal["there", "turn", "back", "back turned"]
"""How a recording is gone through; `turn` is the turn at its end, `back turned` the way back after it."""
MAX_APART = 0.05
"""Of the extent of a clip's poses: how far apart the same image may lie, median, when its place is seen again."""
MIN_SHARED_PCT = 50.0
"""Frames of a way back that must be found where the way there was."""


@dataclass(frozen=True, slots=True)
class Part:
    """A recording's place in a joined one."""

    name: str
    way: Way = "there"

    def __str__(self) -> str:
        return self.name if self.way == "there" else f"{self.name} {self.way}"

    @property
    def shows_again(self) -> bool:
        """Whether it is a way back."""
        return self.way in ("back", "back turned")

    def of(self, clip: Clip) -> Clip:
        """The recording gone through that way."""
        if self.way == "turn":
            return clip.turning()
        seen = clip.backwards() if self.shows_again else clip
        return seen.upside_down() if self.way == "back turned" else seen


Joining = tuple[Part, ...]


def planned(names: Sequence[str], kinds: Sequence[str]) -> list[Joining]:
    """What to join, kind by kind; `between` takes the next recording between a recording and its way back."""
    plans: list[Joining] = []
    if "pairs" in kinds:
        plans += [(Part(a), Part(b)) for a, b in combinations(names, 2)]
    if "back" in kinds:
        plans += [(Part(a), Part(a, "back")) for a in names]
    if "turned" in kinds:
        plans += [(Part(a), Part(a, "turn"), Part(a, "back turned")) for a in names]
    if "between" in kinds and len(names) > 1:
        plans += [(Part(a), Part(b), Part(a, "back")) for a, b in zip(names, [*names[1:], names[0]], strict=True)]
    return plans


def title(plan: Joining) -> str:
    """A joined recording in words."""
    return " + ".join(map(str, plan))


def run_one(clips: Mapping[str, Clip], plan: Joining, gap_s: float, settings: Settings) -> dict[str, Any]:
    """Figures and verdict of one joined recording."""
    joined = join([part.of(clips[part.name]) for part in plan], gap_s)
    return judge(run(joined, settings), plan, joined)


def run(joined: Joined, settings: Settings) -> Run:
    """A joined recording through the system."""
    slam = Slam(joined.camera, settings.config, settings.extractor, settings.matcher)
    for frame in joined.frames:
        slam.process(frame)
    return slam.finish()


def judge(finished: Run, plan: Joining, joined: Joined) -> dict[str, Any]:
    """What a run made of a joined recording.

    `false_poses`: poses in a map of another scene, which is the scene with most poses in it. `found_again_pct`: of the images that come back later, those whose
    second sight is in the map of their first; `apart`: median distance of the two, over the extent of the first clip's poses. None where nothing comes back.
    """
    placed = [f for f in finished.frames if f.world_from_camera is not None]
    scene_of = {name: i for i, name in enumerate(dict.fromkeys(part.name for part in plan))}
    scenes = np.array([scene_of[plan[part].name] for part in joined.part.tolist()])
    false = 0
    for map_id in {f.map_id for f in placed}:
        counts = np.bincount([scenes[f.index] for f in placed if f.map_id == map_id])
        false += int(counts.sum() - counts.max())
    found, apart = _seen_again(placed, plan, joined)
    result: dict[str, Any] = {
        "parts": [str(part) for part in plan], "frames": len(joined.frames),
        "tracked_pct": [round(100.0 * sum(joined.part[f.index] == i for f in placed) / int((joined.part == i).sum()), 1) for i in range(len(plan))],
        "maps": len(finished.maps), "losses": finished.losses, "relocalizations": finished.relocalizations, "loops": finished.loops, "merges": finished.merges,
        "false_poses": false, "found_again_pct": found, "apart": apart,
    }  # fmt: skip
    return result | {"verdict": _verdict(result)}


def _seen_again(placed: Sequence[FrameRecord], plan: Joining, joined: Joined) -> tuple[float | None, float | None]:
    pairs = [(i, k) for k, later in enumerate(plan) for i, first in enumerate(plan[:k]) if first == Part(later.name) and later.shows_again]
    if not pairs:
        return None, None
    sights = {(int(joined.part[f.index]), int(joined.source[f.index])): f for f in placed}
    wanted, distances = 0, []
    for first, later in pairs:
        extent = _extent([f for (part, _), f in sights.items() if part == first])
        for source in joined.source[joined.part == later].tolist():
            wanted += 1
            before, again = sights.get((first, source)), sights.get((later, source))
            if before is not None and again is not None and before.map_id == again.map_id:
                distances.append(float(np.linalg.norm(_position(before) - _position(again))) / max(extent, 1e-9))
    return round(100.0 * len(distances) / wanted, 1), round(float(np.median(distances)), 4) if distances else None


def _verdict(result: Mapping[str, Any]) -> str:
    if result["false_poses"]:
        return "wrong: two scenes in one map"
    if not all(result["tracked_pct"]):
        return "says nothing: a part has no pose"
    if result["found_again_pct"] is None:
        return "right"
    if result["found_again_pct"] < MIN_SHARED_PCT:
        return "wrong: not found again"
    return "right" if result["apart"] <= MAX_APART else "wrong: found elsewhere"


def _extent(records: Sequence[FrameRecord]) -> float:
    """Diagonal of the box around the poses of the map that holds most of them."""
    if not records:
        return 0.0
    ids = [f.map_id for f in records]
    main = max(set(ids), key=ids.count)
    return float(np.linalg.norm(np.ptp([_position(f) for f in records if f.map_id == main], axis=0)))


def _position(record: FrameRecord) -> NDArray[np.float64]:
    assert record.world_from_camera is not None
    return record.world_from_camera[:3, 3]
