"""`thegra score`: a trajectory file against ground truth."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from thegra_core.evaluation.scores import Settings, score_files
from thegra_core.outputs.scoring import MIN_COVERAGE_PCT

_COVERAGE = (
    ("tracked_pct", "coverage", "{:.2f} % of {frames} frames have a pose"),
    ("pairs_pct", "scored", "{pairs} frames ({:.2f} %) have pose and ground truth, over {time_pct:g} % of the time"),
    ("path_scored", "reference, scored part", "path {:.5g}, RMS spread {spread:.5g}"),
)
_ERRORS = (
    ("ate_rmse", "ATE RMSE", "{:.5g} over {pairs} frames, aligned by Sim(3)"),
    ("ate_pct", "ATE / path", "{:.3g} % of {path_length:.5g}"),
    ("ate_rel", "ATE / spread", "{:.3g} (near 0.75: nothing was estimated)"),
    ("ate_median", "ATE median", "{:.5g}"),
    ("ate_max", "ATE largest", "{:.5g}"),
    ("rot_deg", "rotation, median", "{:.3g} deg"),
    ("rpe_trans_rmse", "RPE translation", "{:.4g} from frame to frame"),
    ("rpe_rot_rmse_deg", "RPE rotation", "{:.3g} deg from frame to frame"),
    ("recall_1pct", "recall", "{:.2f} % of frames are within 1 % of the path"),
)
_OTHERS = (
    ("scale", "scale", "{:.6g}"),
    ("in_closure", "in closures", "{} poses claimed while the shutter was closed"),
)


def score_command(trajectory: Path, groundtruth: Path, images: Path | None, shutter: Path | None, settings: Settings, as_json: bool) -> None:
    """Print the scores, as a table or as JSON.

    Raises:
        InputError: If a file cannot be read.
    """
    figures = score_files(trajectory, groundtruth, images, shutter, settings).as_dict()
    if as_json:
        print(json.dumps(figures, indent=2, allow_nan=False))
        return
    table = Table(title=f"{trajectory} against {groundtruth}", show_header=False, title_justify="left")
    for name, value in score_rows(figures):
        table.add_row(name, value)
    Console(highlight=False).print(table)


def score_rows(figures: dict[str, Any]) -> list[tuple[str, str]]:
    """Name and value of each score, coverage first; what cannot be told says why."""
    rows = _formatted(_COVERAGE, {k: v for k, v in figures.items() if k != "path_scored" or figures["pairs"]})
    if figures["ate_rmse"] is None:
        rows.append(("ATE RMSE", f"needs 3 frames with pose and ground truth, there are {figures['pairs']}"))
        rows += _formatted(_ERRORS[-1:], figures)
    elif not figures["covered"]:
        rows.append(("ATE RMSE", f"- (not told: fewer than {MIN_COVERAGE_PCT:g} % of the frames have a pose; without --images FILE the frames are the ground truth's)"))
        rows += _formatted(_ERRORS[-1:], figures)
    else:
        rows += _formatted(_ERRORS[:1], figures)
        rows += _formatted(_ERRORS[1:3], figures) or [(name, "the ground truth does not move") for _, name, _ in _ERRORS[1:3]]
        rows += _formatted(_ERRORS[3:], figures)
    return rows + _fits(figures) + _formatted(_OTHERS, figures)


def _formatted(forms: Iterable[tuple[str, str, str]], figures: dict[str, Any]) -> list[tuple[str, str]]:
    return [(name, form.format(figures[key], **figures)) for key, name, form in forms if figures.get(key) is not None]


def _fits(figures: dict[str, Any]) -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    if "time_offset_s" in figures:
        told = "not fitted: {time_offset_reason}" if figures["time_offset_s"] is None else "{time_offset_s:+.4f} s added to the reference's stamps (fitted, correlation {time_offset_correlation:.3f})"
        rows.append(("time offset", told.format(**figures)))
    if "lever_arm" in figures:
        arm = figures["lever_arm"]
        place = "" if arm is None else ", ".join(f"{v:.4g}" for v in arm)
        rows.append(("lever arm", f"not fitted: {figures['lever_arm_reason']}" if arm is None else f"camera at ({place}) in the body's frame (fitted)"))
    if figures.get("ate_rmse_unfitted") is not None and figures["covered"]:
        rows.append(("ATE without the fits", f"{figures['ate_rmse_unfitted']:.5g}"))
    return rows
