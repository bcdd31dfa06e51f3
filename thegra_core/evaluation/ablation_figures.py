"""The ablation as box plots."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from thegra_core.evaluation.ablation import Row

_STYLE: Any = {"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}
_BLUE, _ORANGE = "#1f6feb", "#d9822b"


def box_plots(rows: Sequence[Row], title: str) -> bytes:
    """A PNG of one group: frames tracked until loss, and the error over the reference's spread, a box a variant with every run as a point."""
    names = list(dict.fromkeys(row.variant.name for row in rows))
    by_name = [[row.result.figures for row in rows if row.variant.name == name] for name in names]
    tracked = [[figures.get("tracked_until_loss_pct", 0.0) for figures in group] for group in by_name]
    errors = [[100 * figures["ate_rel"] for figures in group if figures.get("ate_rel") is not None] for group in by_name]
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(2 * max(2.4, 0.8 + 0.45 * len(names)), 3.8), layout="constrained", dpi=110)
        FigureCanvasAgg(figure)
        left, right = figure.subplots(1, 2)
        _paint(left, tracked, names, _BLUE, "tracked until loss / %")
        left.set_ylim(0, 103)
        _paint(right, errors, names, _ORANGE, "ATE over spread / %")
        right.set_ylim(bottom=0)
        figure.suptitle(title, x=0.01, ha="left", fontsize=9)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _paint(axes: Axes, groups: Sequence[Sequence[float]], names: Sequence[str], colour: str, label: str) -> None:
    places = np.arange(len(names))
    boxes = axes.boxplot(groups, positions=places, widths=0.5, patch_artist=True, manage_ticks=False, showfliers=False, medianprops={"color": "black"})
    for box in boxes["boxes"]:
        box.set(facecolor=colour, alpha=0.4, edgecolor=colour)
    for place, values in zip(places, groups, strict=True):
        offsets = np.linspace(-0.15, 0.15, len(values)) if len(values) > 1 else np.zeros(len(values))
        axes.plot(place + offsets, values, ".", color=colour, ms=4)
    axes.set_xticks(places, names, rotation=40, ha="right", rotation_mode="anchor")
    axes.set_ylabel(label)
