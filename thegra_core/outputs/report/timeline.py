"""What became of each frame, as stretches of time and as events in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, unique
from itertools import groupby

import numpy as np

from thegra_core.messages import FrameRecord, Revisit, Run, TrackingState
from thegra_core.outputs.metrics import is_bad
from thegra_core.outputs.trajectory import NS_PER_S

_GAP_PERIODS = 3.0  # a longer gap between stamps is shown as a gap, not as a long frame
_MAX_EVENTS = 60


@unique
class Fate(Enum):
    """The final account of a frame; the value is its name in the legend."""

    TRACKED = "tracked"
    AFTERWARDS = "localised afterwards"
    OTHER_MAP = "in another map"
    HELD = "held (predicted)"
    LOST = "lost"
    INITIALIZING = "initializing"
    BAD = "bad frame"


@dataclass(frozen=True, slots=True)
class Stretch:
    """Consecutive frames of one fate, from begin_s to end_s of the recording's time."""

    fate: Fate
    begin_s: float
    end_s: float
    frames: int


@dataclass(frozen=True, slots=True)
class Event:
    """Something worth knowing, at a time of the recording and a frame."""

    time_s: float
    frame: int
    text: str


def fate_of(frame: FrameRecord, run: Run) -> Fate:
    """What became of one frame of a run."""
    if is_bad(frame, run):
        return Fate.BAD
    if frame.world_from_camera is not None:
        if frame.map_id != run.main_map_id:
            return Fate.OTHER_MAP
        return Fate.AFTERWARDS if frame.localized_afterwards else Fate.TRACKED
    if frame.result.state is TrackingState.HOLD:
        return Fate.HELD
    return Fate.INITIALIZING if frame.result.state in (TrackingState.INITIALIZING, TrackingState.WAITING) else Fate.LOST


def times_s(frames: Sequence[FrameRecord]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Seconds (F,) of each frame since the first."""
    stamps = np.array([f.stamp_ns for f in frames], np.int64)
    return np.asarray((stamps - stamps[0]) / NS_PER_S) if len(stamps) else np.empty(0)


def stretches(run: Run) -> list[Stretch]:
    """The whole run as stretches in time order; where stamps leave a gap, there is a gap."""
    frames = sorted(run.frames, key=lambda f: f.stamp_ns)
    times = times_s(frames)
    if len(frames) == 0:
        return []
    steps = np.diff(times)
    period = (float(np.median(steps)) if len(steps) else 0.0) or 1.0  # 0: most stamps repeat
    lengths = np.append(np.where(steps > _GAP_PERIODS * period, period, steps), period)
    found: list[Stretch] = []
    for i, frame in enumerate(frames):
        fate = fate_of(frame, run)
        begin, end = float(times[i]), float(times[i] + lengths[i])
        if found and found[-1].fate is fate and begin - found[-1].end_s < 1e-6:
            found[-1] = Stretch(fate, found[-1].begin_s, end, found[-1].frames + 1)
        else:
            found.append(Stretch(fate, begin, end, 1))
    return found


def events(run: Run) -> list[Event]:
    """Changes of state, loops and merges, in words, at most a page of them."""
    if not run.frames:
        return []
    times = dict(zip((f.index for f in run.frames), times_s(run.frames).tolist(), strict=True))
    told: list[Event] = []
    before: TrackingState | None = None
    known: set[int] = set()
    for state, group in groupby(run.frames, key=lambda f: f.result.state):
        members = list(group)
        told.append(Event(times[members[0].index], members[0].index, _describe(before, state, members, known)))
        before = state
        known |= {f.result.map_id for f in members if state is TrackingState.TRACKING}
    by_stamp = {f.stamp_ns: f.index for f in run.frames}
    told += [Event(times[by_stamp[r.stamp_ns]], by_stamp[r.stamp_ns], _revisit(r)) for r in run.revisits if r.stamp_ns in by_stamp]
    told.sort(key=lambda event: event.time_s)
    if len(told) > _MAX_EVENTS:
        rest = len(told) - _MAX_EVENTS
        told = [*told[:_MAX_EVENTS], Event(told[_MAX_EVENTS].time_s, told[_MAX_EVENTS].frame, f"... and {rest} more")]
    return told


def _revisit(revisit: Revisit) -> str:
    seen = f"keyframe {revisit.keyframe_id} sees by {revisit.landmarks} landmarks what keyframe {revisit.old_keyframe_id} saw"
    if revisit.is_loop:
        return f"loop closed in map {revisit.map_id}: {seen}; it moves by {revisit.moved:.3f} of the scene's depth, scale {revisit.scale:.3f}"
    return f"map {revisit.absorbed_map_id} becomes part of map {revisit.map_id}: {seen}; scale {revisit.scale:.3f}"


def _describe(before: TrackingState | None, state: TrackingState, frames: list[FrameRecord], known_maps: set[int]) -> str:
    last_reason = next((f.result.reason for f in reversed(frames) if f.result.reason), "")
    because = f": {last_reason}" if last_reason else ""
    count = f"{len(frames)} frame{'s' if len(frames) > 1 else ''}"
    if state is TrackingState.TRACKING:
        map_id = frames[0].result.map_id
        if map_id not in known_maps:
            return f"{'another map begins' if known_maps else 'first map made'}, tracking in map {map_id} ({count})"
        again = "tracking goes on after the shutter" if before is TrackingState.HOLD else "tracking again"
        return f"{again} in map {map_id} ({count})"
    names = {
        TrackingState.WAITING: "waiting for the camera's calibration",
        TrackingState.INITIALIZING: "initializing",
        TrackingState.HOLD: "shutter closed, pose predicted",
        TrackingState.LOST: "lost",
        TrackingState.RELOCALIZING: "looking for a known place",
    }
    return f"{names[state]} ({count}){because}"
