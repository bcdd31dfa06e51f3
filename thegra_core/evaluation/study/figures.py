"""The study as pictures: box plots as in the paper's Figs. 2 to 4, and detections before and after the paper's chain (its Fig. 1)."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from thegra_core.evaluation.study.run import Row
from thegra_core.messages import Features

_STYLE: Any = {"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}
_BLUE, _ORANGE = "#1f6feb", "#d9822b"


def box_plots(rows: Sequence[Row], names: Sequence[str], by: str, title: str) -> bytes:
    """A PNG: for each recording the matches and the MAGSAC inliers a pair of each name; `by` is the field of `Row` that holds the name."""
    recordings = list(dict.fromkeys(row.recording for row in rows))
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(max(3.2, 1.2 + 0.45 * len(names)) * len(recordings), 4.6), layout="constrained", dpi=110)
        FigureCanvasAgg(figure)
        panels = np.atleast_1d(figure.subplots(1, len(recordings)))
        for axes, recording in zip(panels, recordings, strict=True):
            mine = [row for row in rows if row.recording == recording]
            _paint_boxes(axes, [[row for row in mine if getattr(row, by) == name] for name in names], names)
            axes.set_title(recording, loc="left")
        figure.suptitle(title, x=0.01, ha="left", fontsize=9)
        return _png(figure)


def detections(before: NDArray[np.uint8], features_before: Features, after: NDArray[np.uint8], features_after: Features) -> bytes:
    """A PNG: keypoints on a stretched image and on one from the paper's chain, the stronger the larger."""
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(9.0, 3.9), layout="constrained", dpi=110)
        FigureCanvasAgg(figure)
        for axes, image, features, name in zip(
            figure.subplots(1, 2), (before, after), (features_before, features_after), ("stretched", "pre-processed"), strict=True
        ):
            axes.imshow(image, cmap="gray", vmin=0, vmax=255)
            axes.scatter(*features.keypoints.T, s=2 + 30 * features.scores, facecolors="none", edgecolors=_ORANGE, linewidths=0.6)
            axes.set_axis_off()
            axes.set_title(f"{name}: {int((features.scores > 0.05).sum())} keypoints with a score above 0.05", loc="left")
        return _png(figure)


def _paint_boxes(axes: Axes, groups: Sequence[Sequence[Row]], names: Sequence[str]) -> None:
    places = np.arange(len(names))
    for offset, values, colour, label in (
        (-0.18, [[row.result.matches for row in group] for group in groups], _BLUE, "matches"),
        (0.18, [[row.result.inliers for row in group] for group in groups], _ORANGE, "MAGSAC inliers"),
    ):
        boxes = axes.boxplot(
            values, positions=places + offset, widths=0.3, patch_artist=True, manage_ticks=False,
            flierprops={"marker": ".", "markersize": 3, "markeredgecolor": colour}, medianprops={"color": "black"},
        )  # fmt: skip
        for box in boxes["boxes"]:
            box.set(facecolor=colour, alpha=0.5, edgecolor=colour)
        axes.plot([], [], color=colour, lw=5, alpha=0.5, label=label)
    axes.set_xticks(places, names, rotation=40, ha="right", rotation_mode="anchor")
    axes.set_ylim(bottom=0)
    axes.set_ylabel("per pair")
    axes.legend(loc="best", frameon=False)


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
