"""The figures of a run, flat and by the names that scripts rely on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from thegra_core.config import ThegraConfig
from thegra_core.messages import FrameRecord, Revisit, Run, TrackingState
from thegra_core.outputs.scoring import Score, path_length, score_trajectory, within
from thegra_core.outputs.trajectory import NS_PER_S, Trajectory, final_trajectory, live_trajectory
from thegra_core.process import own_usage
from thegra_core.version import VERSION

TOTAL = "total"
"""Stage that covers all others of a frame."""
_LOST = (TrackingState.LOST, TrackingState.RELOCALIZING)
_WAITING = (TrackingState.INITIALIZING, TrackingState.WAITING)


@dataclass(frozen=True, slots=True)
class Timing:
    """What the run cost.

    wall_s covers all frames, without the work after the last one (`finish_s`); frames_read counts the frames that were handed to the system.
    cached_pct is the share of the networks' results that came from a cache, None without one. latency_ms, of a recording that was played at its own rate:
    from a frame's delivery to its pose. cpu_s: of all processes and cores, for the frames of `wall_s`. apart_rss_mb: the most memory of a process beside this.
    """

    wall_s: float
    frames_read: int
    finish_s: float = 0.0
    dropped_frames: int = 0
    cached_pct: float | None = None
    latency_ms: Sequence[float] = ()
    cpu_s: float = 0.0
    apart_rss_mb: float = 0.0


@dataclass(frozen=True, slots=True)
class RunScores:
    """Scores of the main map, from the finished map and as estimated at the time, against `truth`: the ground truth over the frames' time."""

    final: Score
    live: Score
    truth: Trajectory


def score_run(run: Run, groundtruth: Trajectory) -> RunScores:
    """Score the main map against the part of the ground truth that the frames span."""
    stamps = np.unique(np.array([f.stamp_ns for f in run.frames], np.int64))
    truth = within(groundtruth, stamps)
    final, live = (
        score_trajectory(make(run, run.main_map_id), groundtruth, stamps, path=path_length(truth.positions)) for make in (final_trajectory, live_trajectory)
    )
    return RunScores(final, live, truth)


def run_metrics(
    run: Run, config: ThegraConfig, timing: Timing, scores: RunScores | None = None, unreadable: Mapping[str, int] | None = None
) -> dict[str, Any]:
    """Everything `metrics.json` holds; the keys for ground truth are there only when it was given.

    `unreadable` counts images that the recording holds but nobody could read, by reason; they count among all frames, and as bad.
    """
    tracked = [f for f in run.frames if f.world_from_camera is not None]
    in_main = sum(f.map_id == run.main_map_id for f in tracked)
    bad = dict(Counter(run.bad_frames) + Counter(unreadable or {}))
    total = max(timing.frames_read, len(run.frames)) + timing.dropped_frames + sum((unreadable or {}).values())
    metrics: dict[str, Any] = {
        "frames_total": total,
        "frames_tracked": in_main,
        "frames_tracked_other_maps": len(tracked) - in_main,
        "frames_localized_afterwards": sum(f.localized_afterwards for f in tracked),
        "frames_held": _count(run, (TrackingState.HOLD,)),
        "frames_lost": _count(run, _LOST),
        "frames_initializing": _count(run, _WAITING),
        "frames_bad": sum(bad.values()),
        "bad_frames": bad,
        "tracked_pct": _percent(in_main, total),
        "tracked_any_pct": _percent(len(tracked), total),
        "tracked_until_loss_pct": _percent(_until_loss(run), total),
        "maps": len(run.maps),
        "keyframes": sum(len(m.keyframe_stamps_ns) for m in run.maps),
        "landmarks": sum(len(m.points_world) for m in run.maps),
        "losses": run.losses,
        "relocalizations": run.relocalizations,
        "loops": run.loops,
        "merges": run.merges,
        "loop_events": [_revisit(r) for r in run.revisits],
        "loss_events": _losses(run),
        "shutter_closures": [[begin / NS_PER_S, end / NS_PER_S] for begin, end in run.shutter_closures_ns],
    }
    return metrics | (_score_metrics(scores) if scores else {}) | _time_metrics(run, timing) | {"seed": config.seed, "profile": config.profile, "version": VERSION}


def _revisit(revisit: Revisit) -> dict[str, Any]:
    """A loop or a merge: when, which keyframes, by how many landmarks, and what it set right (`moved` in median scene depths)."""
    facts = asdict(revisit)
    facts["stamp_s"] = facts.pop("stamp_ns") / NS_PER_S
    return {"kind": "loop" if revisit.is_loop else "merge", **facts}


def _losses(run: Run) -> list[dict[str, Any]]:
    """Each time that tracking was lost: when, why, and when it went on (None: it did not) in which map."""
    found: list[dict[str, Any]] = []
    told = [f.result for f in run.frames if f.result.reason not in run.bad_frames and f.result.state is not TrackingState.HOLD]
    for before, result in pairwise(told):
        if result.state is TrackingState.LOST and before.state in (TrackingState.TRACKING, TrackingState.RELOCALIZING):
            found.append({"lost_s": result.stamp_ns / NS_PER_S, "reason": result.reason, "found_s": None, "map_id": None})
        elif result.state is TrackingState.TRACKING and found and found[-1]["found_s"] is None:
            found[-1] |= {"found_s": result.stamp_ns / NS_PER_S, "map_id": result.map_id}
    return found


def percentiles(values: Sequence[float] | np.ndarray[Any, Any], which: Iterable[int]) -> dict[str, float | None]:
    """{"p50": ..., ...}; None each when there are no values."""
    return {f"p{p}": round(float(np.percentile(values, p)), 3) if len(values) else None for p in which}


def _score_metrics(scores: RunScores) -> dict[str, Any]:
    final = scores.final
    return {
        "ate_rmse": final.ate_rmse,
        "ate_live_rmse": scores.live.ate_rmse,
        "ate_scale": final.scale,
        "path_length": final.path_length,
        "ate_pct": final.ate_pct,
        "ate_rel": final.ate_rel,
        "ate_pairs": final.pairs,
        "ate_pairs_pct": final.pairs_pct,
        "ate_time_pct": final.time_pct,
        "ate_path": final.path_scored,
        "ate_spread": final.spread,
        "ate_median": final.ate_median,
        "ate_max": final.ate_max,
        "rot_deg": final.rot_deg,
        "recall_1pct": final.recall_1pct,
    }


def _time_metrics(run: Run, timing: Timing) -> dict[str, Any]:
    stages: dict[str, list[float]] = {}
    for frame in run.frames:
        for stage, ms in frame.result.stage_ms.items():
            stages.setdefault(stage, []).append(ms)
    frame_ms = [f.result.stage_ms.get(TOTAL, sum(f.result.stage_ms.values())) for f in run.frames if f.result.stage_ms]
    return {
        "fps": round(timing.frames_read / timing.wall_s, 3) if timing.wall_s > 0 else None,
        "ms_per_frame": percentiles(frame_ms, (50, 95, 99)),
        "ms": {stage: percentiles(values, (50, 95, 99)) for stage, values in stages.items()},
        "wall_s": round(timing.wall_s, 3),
        "finish_s": round(timing.finish_s, 3),
        "dropped_frames": timing.dropped_frames,
        "latency_ms": percentiles(timing.latency_ms, (50, 95, 99)),
        "cpu_s_per_frame": round(timing.cpu_s / timing.frames_read, 4) if timing.frames_read else None,
        "cached_pct": timing.cached_pct,
        "peak_rss_mb": round(own_usage().peak_rss_mb + timing.apart_rss_mb, 1),
    }


def is_bad(frame: FrameRecord, run: Run) -> bool:
    """Whether a frame could not be used at all: its reason is among those that the run counted as bad."""
    return frame.world_from_camera is None and frame.result.reason in run.bad_frames


def _count(run: Run, states: tuple[TrackingState, ...]) -> int:
    return sum(f.world_from_camera is None and f.result.state in states and not is_bad(f, run) for f in run.frames)


def _until_loss(run: Run) -> int:
    """Frames with a pose before tracking was lost for the first time."""
    states = [f.result.state for f in run.frames]
    begin = next((i for i, state in enumerate(states) if state is TrackingState.TRACKING), 0)
    end = next((i for i, state in enumerate(states) if i > begin and state in _LOST), len(states))
    return sum(f.world_from_camera is not None for f in run.frames[:end])


def _percent(part: int, whole: int) -> float:
    return round(100.0 * part / whole, 2) if whole else 0.0
