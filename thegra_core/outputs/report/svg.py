"""Matplotlib figures as inline SVG that takes its colours and font from the page, and so follows light and dark."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

FOREGROUND, MUTED, GRID = "#010101", "#020202", "#030303"
BLUE, ORANGE, GREEN, PURPLE, PINK, TEAL, RED, GREY = (f"#a0000{i}" for i in range(1, 9))
SERIES = (BLUE, ORANGE, GREEN, PURPLE, TEAL, PINK, RED, GREY)

_VARIABLES = {FOREGROUND: "--fg", MUTED: "--muted", GRID: "--grid"} | {c: f"--c{i}" for i, c in enumerate((BLUE, ORANGE, GREEN, PURPLE, PINK, TEAL, RED, GREY), 1)}
_STYLE: Any = {
    "svg.fonttype": "none",
    "font.size": 9,
    "text.color": FOREGROUND,
    "axes.edgecolor": GRID,
    "axes.labelcolor": MUTED,
    "axes.facecolor": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.titlesize": 9,
    "axes.titlecolor": MUTED,
    "axes.titlelocation": "left",
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": GRID,
    "ytick.color": GRID,
    "xtick.labelcolor": MUTED,
    "ytick.labelcolor": MUTED,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "lines.linewidth": 1.4,
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    "path.simplify": True,
    "path.simplify_threshold": 0.3,
}


def draw(title: str, size: tuple[float, float], paint: Callable[[Figure], None]) -> str:
    """Inline SVG of what `paint` puts on a figure of `size` inches; `title` is read out by screen readers."""
    with mpl.rc_context({**_STYLE, "svg.hashsalt": title}):  # the salt keeps the ids of one figure from meeting those of another
        figure = Figure(figsize=size, layout="constrained")
        paint(figure)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return _inline(buffer.getvalue(), title)


def _inline(text: str, title: str) -> str:
    """Without what only a file of its own needs: prologue, metadata, namespaces, fixed size, ids that would repeat in the page."""
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", text)
    text = text.replace("xlink:href", "href")
    text = re.sub(r'<g id="[\w.]+_[0-9a-z_]+">', "<g>", text)
    text = re.sub(r'<svg ([^>]*?)width="[^"]*"', r"<svg \1", text)
    text = re.sub(r'<svg ([^>]*?)height="[^"]*"', rf'<svg role="img" aria-label="{title}" \1', text)
    for colour, variable in _VARIABLES.items():
        text = text.replace(colour, f"var({variable})")
    return text
