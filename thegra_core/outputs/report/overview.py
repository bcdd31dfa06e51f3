"""One picture of a run to show to others: a frame with its tracks beside the path and the map."""

from __future__ import annotations

import io

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from thegra_core.messages import FloatArray, Run, Snapshot, TrackingState
from thegra_core.outputs.scoring import Alignment, RunPoses

_TRACKED, _UNTRACKED, _PATH, _LANDMARKS = "#ffd166", "#6ec6ff", "#1f6feb", "#9aa4ae"
_MARGIN = 0.15
"""The view of the map reaches past the path and the middle 90 % of the landmarks by this share of their extent."""


def overview(run: Run, poses: RunPoses, alignment: Alignment | None, unit: str) -> bytes:
    """A PNG: a tracked frame as the extractor saw it, and path (ground truth dashed) and landmarks from the side that shows most of the path.

    `alignment` is what brought `poses` into the frame of the ground truth, None where there is none.
    """
    points = next(m.points_world for m in run.maps if m.map_id == run.main_map_id)
    if alignment is not None:
        points = alignment.apply(points)
    snapshot = _busiest(run.snapshots)
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(9.0, 3.8), layout="constrained", dpi=110)
        FigureCanvasAgg(figure)
        left, right = figure.subplots(1, 2) if snapshot is not None else (None, figure.subplots())
        if left is not None and snapshot is not None:
            _paint_frame(left, snapshot)
        _paint_map(right, poses, points, unit)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", bbox_inches="tight", metadata={"Software": None})
    return buffer.getvalue()


def _busiest(snapshots: tuple[Snapshot, ...]) -> Snapshot | None:
    """The tracked frame with the longest tracks, which shows most of what the system sees."""
    tracked = [s for s in snapshots if s.state is TrackingState.TRACKING and s.tracked.any()]
    return max(tracked, key=lambda s: (float(np.nansum(np.linalg.norm(s.keypoints - s.previous, axis=1)[s.tracked])), s.stamp_ns)) if tracked else None


def _paint_frame(axes: Axes, snapshot: Snapshot) -> None:
    axes.imshow(snapshot.image, cmap="gray", vmin=0, vmax=255)
    keypoints, tracked = snapshot.keypoints, snapshot.tracked
    axes.scatter(keypoints[~tracked, 0], keypoints[~tracked, 1], s=3, color=_UNTRACKED, linewidths=0)
    moved = tracked & np.isfinite(snapshot.previous).all(axis=1)
    axes.add_collection(LineCollection(list(np.stack((snapshot.previous[moved], keypoints[moved]), axis=1)), colors=_TRACKED, linewidths=0.7))
    axes.scatter(keypoints[tracked, 0], keypoints[tracked, 1], s=6, color=_TRACKED, linewidths=0)
    axes.set_axis_off()
    axes.set_title(f"{int(tracked.sum())} of {len(keypoints)} keypoints see a landmark", loc="left")


def _paint_map(axes: Axes, poses: RunPoses, points: FloatArray, unit: str) -> None:
    across, up = sorted(np.argsort(-np.ptp(poses.estimate, axis=0), kind="stable")[:2].tolist())
    axes.scatter(points[:, across], points[:, up], s=2, color=_LANDMARKS, linewidths=0, label="landmarks")
    if poses.groundtruth is not None:
        axes.plot(poses.groundtruth[:, across], poses.groundtruth[:, up], color="black", lw=1.0, ls="--", label="ground truth")
    axes.plot(poses.estimate[:, across], poses.estimate[:, up], color=_PATH, lw=1.6, marker="." if len(poses.estimate) < 300 else "", ms=3, label="estimate")
    shown = np.vstack((poses.estimate, np.percentile(points, (5, 95), axis=0))) if len(points) else poses.estimate
    low, high = shown.min(axis=0), shown.max(axis=0)
    pad = _MARGIN * max(high[across] - low[across], high[up] - low[up], 1e-9)
    axes.set(xlim=(low[across] - pad, high[across] + pad), ylim=(low[up] - pad, high[up] + pad))
    axes.set_aspect("equal", adjustable="box")
    axes.set(xlabel=f"{'xyz'[across]} / {unit}", ylabel=f"{'xyz'[up]} / {unit}")
    if poses.groundtruth is None and "xyz"[up] == "y":
        axes.invert_yaxis()
    axes.legend(loc="best", frameon=False, fontsize=8)
