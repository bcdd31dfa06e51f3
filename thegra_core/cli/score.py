"""`thegra score`: a trajectory file against ground truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from thegra_core.evaluation.scores import score_files

_ROWS = (
    ("tracked_pct", "coverage", "{:.2f} % of {frames} frames have a pose"),
    ("ate_rmse", "ATE RMSE", "{:.5g} over {pairs} frames, aligned by Sim(3)"),
    ("ate_pct", "ATE / path", "{:.3g} % of {path_length:.5g}"),
    ("ate_rel", "ATE / spread", "{:.3g} (near 0.75: nothing was estimated)"),
    ("ate_median", "ATE median", "{:.5g}"),
    ("ate_max", "ATE largest", "{:.5g}"),
    ("rot_deg", "rotation, median", "{:.3g} deg"),
    ("rpe_trans_rmse", "RPE translation", "{:.4g} from frame to frame"),
    ("rpe_rot_rmse_deg", "RPE rotation", "{:.3g} deg from frame to frame"),
    ("recall_1pct", "recall", "{:.2f} % of frames are within 1 % of the path"),
    ("scale", "scale", "{:.6g}"),
    ("in_closure", "in closures", "{} poses claimed while the shutter was closed"),
)


def score_command(trajectory: Path, groundtruth: Path, images: Path | None, shutter: Path | None, tolerance_s: float | None, as_json: bool) -> None:
    """Print the scores, as a table or as JSON.

    Raises:
        InputError: If a file cannot be read.
    """
    figures = score_files(trajectory, groundtruth, images, shutter, tolerance_s).as_dict()
    if as_json:
        print(json.dumps(figures, indent=2, allow_nan=False))
        return
    table = Table(title=f"{trajectory} against {groundtruth}", show_header=False, title_justify="left")
    for name, value in score_rows(figures):
        table.add_row(name, value)
    Console(highlight=False).print(table)


def score_rows(figures: dict[str, Any]) -> list[tuple[str, str]]:
    """Name and value of each score, coverage first; what cannot be told says why."""
    few = f"needs 3 frames with pose and ground truth, there are {figures['pairs']}"
    rows: list[tuple[str, str]] = []
    for key, name, form in _ROWS:
        if key in ("ate_pct", "ate_rel") and figures[key] is None and figures["ate_rmse"] is not None:
            rows.append((name, "the ground truth does not move"))
        elif figures[key] is not None:
            rows.append((name, form.format(figures[key], **figures)))
        elif key == "ate_rmse":
            rows.append((name, few))
    return rows
