"""The figures of the report, each a function of the run to inline SVG."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from thegra_core.messages import FloatArray, FrameRecord, Run
from thegra_core.outputs.metrics import TOTAL
from thegra_core.outputs.report.svg import BLUE, FOREGROUND, GREEN, GREY, ORANGE, SERIES, TEAL, draw
from thegra_core.outputs.report.timeline import times_s
from thegra_core.outputs.scoring import RunPoses, Score
from thegra_core.outputs.trajectory import NS_PER_S

_AXES = "xyz"
_TIME = "time / s"
_WIDE = (5.6, 3.2)
_MAX_POINTS = 1500  # a line of a long run is thinned to about this many, more than a screen can show
_MAX_MARKERS = 300


def trajectory_figure(poses: RunPoses, unit: str) -> str:
    """The path in the two axis-aligned projections that show most of it; ground truth dashed when there is one.

    Without ground truth the world is the first camera's: its y points down, and so it is drawn.
    """
    everything = poses.estimate if poses.groundtruth is None else np.vstack([poses.estimate, poses.groundtruth])
    order = np.argsort(-np.ptp(everything, axis=0), kind="stable")
    views = [tuple(sorted((int(order[0]), int(other)))) for other in order[1:]]

    def paint(figure: Figure) -> None:
        for axes, (across, up) in zip(np.ravel(figure.subplots(1, 2)), views, strict=True):
            _paint_projection(axes, poses, across, up, unit)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4)

    return draw("trajectory in two projections", (5.6, 3.6), paint)


def error_figure(frames: Sequence[FrameRecord], final: Score, live: Score, closures_ns: Sequence[tuple[int, int]], unit: str) -> str:
    """Position error after alignment, per frame; of the finished map and of the poses as they were estimated at the time."""
    first = min(f.stamp_ns for f in frames)
    stamps = np.unique([f.stamp_ns for f in frames])
    times = (stamps - first) / NS_PER_S
    bins = _bins(len(stamps))

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        _shade_closures(axes, closures_ns, first)
        for score, colour, label, width in ((live, ORANGE, "as estimated at the time", 1.0), (final, BLUE, "finished map", 1.6)):
            if score.errors is not None and score.stamps_ns is not None:
                errors = np.fmax.reduceat(_with_gaps(stamps, score.stamps_ns, score.errors), bins)
                axes.plot(times[bins], errors, color=colour, lw=width, label=label, marker=_marker(len(bins)), ms=2)
        if final.ate_rmse is not None:
            axes.axhline(final.ate_rmse, color=FOREGROUND, lw=0.8, ls=":", label=f"RMSE {final.ate_rmse:.3g} {unit}")
        axes.set(xlabel=_TIME, ylabel=f"position error / {unit}", xlim=_limits(times))
        axes.set_ylim(bottom=0)
        figure.legend(loc="outside lower center", ncols=3)

    return draw("position error over time", _WIDE, paint)


def counts_figure(run: Run) -> str:
    """Keypoints, matches to the reference keyframe, inliers of the pose, over time."""
    shown = [run.frames[i] for i in _bins(len(run.frames))]
    times = times_s(run.frames)
    first = run.frames[0].stamp_ns

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        _shade_closures(axes, run.shutter_closures_ns, first)
        for name, colour in (("keypoints", GREY), ("visible", TEAL), ("matches", ORANGE), ("inliers", BLUE)):
            axes.plot(times[_bins(len(times))], [getattr(f.result, name) for f in shown], color=colour, label=_COUNTS[name])
        axes.set(xlabel=_TIME, ylabel="per frame", xlim=_limits(times))
        axes.set_ylim(bottom=0)
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        figure.legend(loc="outside lower center", ncols=4)

    return draw("keypoints, matches and inliers over time", _WIDE, paint)


def stages_figure(run: Run) -> str:
    """Milliseconds of each stage, stacked, frame by frame; the mean of several frames where a run is long."""
    stages = list(dict.fromkeys(stage for f in run.frames for stage in f.result.stage_ms if stage != TOTAL))
    values = np.array([[f.result.stage_ms.get(stage, 0.0) for f in run.frames] for stage in stages])
    labels = [f"{stage} {mean:.{0 if mean >= 10 else 1}f}" for stage, mean in zip(stages, values.mean(axis=1), strict=True)]
    index = _bins(len(run.frames))
    means = np.add.reduceat(values, index, axis=1) / np.diff(np.append(index, len(run.frames)))

    def paint(figure: Figure) -> None:
        axes = figure.subplots()
        colours = [SERIES[i % len(SERIES)] for i in range(len(stages))]
        axes.stackplot(index, means, labels=labels, colors=colours, alpha=0.85, step="mid", lw=0)
        axes.set(xlabel="frame", ylabel="ms", xlim=_limits(index))
        top = float(np.percentile(means.sum(axis=0), 99)) * 1.15
        axes.set_ylim(0, max(top, 1e-3))
        figure.legend(loc="outside lower center", ncols=3, title="mean ms a frame", title_fontsize=9)

    return draw("stage times per frame", _WIDE, paint)


_COUNTS = {"keypoints": "keypoints", "visible": "landmarks in view", "matches": "matches", "inliers": "inliers"}


def _paint_projection(axes: Axes, poses: RunPoses, across: int, up: int, unit: str) -> None:
    if poses.groundtruth is not None:
        truth = poses.groundtruth[_bins(len(poses.groundtruth))]
        axes.plot(truth[:, across], truth[:, up], color=FOREGROUND, lw=1.0, ls="--", label="ground truth")
    estimate = poses.estimate[_bins(len(poses.estimate))]
    axes.plot(estimate[:, across], estimate[:, up], color=BLUE, label="estimate", marker=_marker(len(estimate)), ms=2.5)
    if len(poses.predicted):
        predicted = poses.predicted[_bins(len(poses.predicted))]
        axes.plot(predicted[:, across], predicted[:, up], color=TEAL, ls="", marker="x", ms=3, label="held (predicted)")
    axes.plot(*poses.estimate[0, [across, up]], color=GREEN, marker="o", ms=5, ls="", label="start")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"{_AXES[across]} / {unit}", ylabel=f"{_AXES[up]} / {unit}")
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    if poses.groundtruth is None and _AXES[up] == "y":
        axes.invert_yaxis()


def _shade_closures(axes: Axes, closures_ns: Sequence[tuple[int, int]], first_ns: int) -> None:
    for number, (begin, end) in enumerate(closures_ns):
        label = "shutter closed" if number == 0 else None
        axes.axvspan((begin - first_ns) / NS_PER_S, (end - first_ns) / NS_PER_S, color=TEAL, alpha=0.15, lw=0, label=label)


def _bins(count: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """First index of each of at most `_MAX_POINTS` equal groups of `count` points."""
    return np.arange(0, count, max(1, -(-count // _MAX_POINTS)), dtype=np.int64)


def _marker(count: int) -> str:
    return "." if count <= _MAX_MARKERS else ""


def _with_gaps(stamps: np.ndarray[Any, Any], known: np.ndarray[Any, Any], values: FloatArray) -> FloatArray:
    """Values at all stamps, NaN where unknown, so that a line breaks there."""
    out = np.full(len(stamps), np.nan)
    out[np.searchsorted(stamps, known)] = values
    return out


def _limits(values: np.ndarray[Any, Any]) -> tuple[float, float]:
    low, high = float(np.min(values)), float(np.max(values))
    return (low, high) if high > low else (low - 0.5, high + 0.5)
