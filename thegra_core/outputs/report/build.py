"""The report page: figures and tables of a run, put into the template."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jinja2
from markupsafe import Markup

from thegra_core.config import ThegraConfig, dump_config
from thegra_core.messages import Run
from thegra_core.outputs.metrics import RunScores
from thegra_core.outputs.report.figures import counts_figure, error_figure, stages_figure, trajectory_figure
from thegra_core.outputs.report.frames import pictures
from thegra_core.outputs.report.timeline import Fate, Stretch, events, fate_of, stretches
from thegra_core.outputs.scoring import MIN_COVERAGE_PCT, RunPoses
from thegra_core.outputs.trajectory import NS_PER_S, Trajectory, final_trajectory, predicted_trajectory

_MAX_LISTED = 12


@dataclass(frozen=True, slots=True)
class ReportInput:
    """All that the page tells about. `metrics` is the content of metrics.json, `problems` a reason to the images that could not be read."""

    run: Run
    config: ThegraConfig
    metrics: Mapping[str, Any]
    name: str
    path: str
    topic: str | None
    image_size: tuple[int, int]
    problems: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    command: str = ""
    started_utc: str = ""
    groundtruth: Trajectory | None = None
    scores: RunScores | None = None


@dataclass(frozen=True, slots=True)
class Tile:
    """One figure at the top of the page."""

    name: str
    value: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Bar:
    """One stretch of the timeline: x and width in thousandths of the run, a CSS class and a text on hover."""

    x: float
    width: float
    css: str
    text: str


def build_report(report: ReportInput) -> str:
    """The page as HTML that needs nothing from outside."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("thegra_core.outputs.report", "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    run = report.run
    parts = stretches(run)
    first_ns = min((f.stamp_ns for f in run.frames), default=0)
    return environment.get_template("report.html.j2").render(
        report=report,
        metrics=report.metrics,
        tiles=_tiles(report),
        bars=_bars(parts),
        keyframe_path=_keyframe_path(run, parts),
        duration_s=parts[-1].end_s if parts else 0.0,
        legend=_legend(run),
        figures=_figures(report),
        pictures=pictures(run.snapshots, first_ns),
        events=events(run),
        warnings=_warnings(report),
        configuration=dump_config(report.config),
    )


def run_poses(report: ReportInput) -> RunPoses | None:
    """Positions to draw, in the frame and unit of the ground truth where the run could be aligned to it; None without a map."""
    estimate = final_trajectory(report.run, report.run.main_map_id).positions
    if len(estimate) == 0:
        return None
    predicted = predicted_trajectory(report.run, report.run.main_map_id).positions
    alignment = report.scores.final.alignment if report.scores else None
    if alignment is None or report.scores is None:
        return RunPoses(estimate, predicted, None)
    return RunPoses(alignment.apply(estimate), alignment.apply(predicted), report.scores.truth.positions)


def _figures(report: ReportInput) -> dict[str, Markup]:
    """Name to SVG; a figure that has nothing to show is not there."""
    run, scores = report.run, report.scores
    poses = run_poses(report)
    drawn: dict[str, str] = {}
    aligned = poses is not None and poses.groundtruth is not None
    if poses is not None:
        drawn["trajectory"] = trajectory_figure(poses, "m" if aligned else "map units")
    if scores is not None and scores.final.errors is not None:
        drawn["error"] = error_figure(run.frames, scores.final, scores.live, run.shutter_closures_ns, "m")
    if run.frames:
        drawn["counts"] = counts_figure(run)
    if any(f.result.stage_ms for f in run.frames):
        drawn["stages"] = stages_figure(run)
    return {name: Markup(svg) for name, svg in drawn.items()}


def _tiles(report: ReportInput) -> list[Tile]:
    m = report.metrics
    speed = f"{m['fps']:.3g} fps" if m["fps"] else "-"
    per_frame = m["ms_per_frame"]["p50"]
    return [
        Tile("Coverage", f"{m['tracked_pct']:.1f} %", f"{m['frames_tracked']} of {m['frames_total']} frames have a pose"),
        _error_tile(m),
        Tile("Map", f"{m['landmarks']:,}".replace(",", " "), f"landmarks in {m['keyframes']} keyframes, {m['maps']} map{'s' if m['maps'] != 1 else ''}"),
        Tile("Losses", str(m["losses"]), f"{m['relocalizations']} relocalisations · {m['loops']} loops · {m['merges']} merges"),
        Tile("Speed", speed, f"{per_frame:.0f} ms a frame (median)" if per_frame is not None else "no stage times"),
        Tile("Memory", f"{m['peak_rss_mb']:.0f} MB", "peak of the process"),
    ]


def _error_tile(m: Mapping[str, Any]) -> Tile:
    if "ate_rmse" not in m:
        return Tile("ATE RMSE", "-", "no ground truth given")
    if m["ate_rmse"] is None:
        return Tile("ATE RMSE", "-", "fewer than 3 frames with pose and ground truth")
    if m["tracked_pct"] < MIN_COVERAGE_PCT:
        return Tile("ATE RMSE", "-", f"fewer than {MIN_COVERAGE_PCT:g} % of the frames have a pose")
    share = f"{m['ate_pct']:.2f} % of a path of {m['path_length']:.4g} m · " if m["ate_pct"] is not None else ""
    return Tile("ATE RMSE", f"{m['ate_rmse']:.3g} m", f"{share}over {m['ate_pairs']} frames, Sim(3)")


def _bars(parts: list[Stretch]) -> list[Bar]:
    if not parts:
        return []
    scale = 1000.0 / parts[-1].end_s
    return [
        Bar(p.begin_s * scale, (p.end_s - p.begin_s) * scale, p.fate.name.lower(), f"{p.fate.value}: {p.begin_s:.2f} to {p.end_s:.2f} s, {p.frames} frames")
        for p in parts
    ]


def _keyframe_path(run: Run, parts: list[Stretch]) -> str:
    if not parts:
        return ""
    first = min(f.stamp_ns for f in run.frames)
    seconds = [(stamp - first) / NS_PER_S for m in run.maps for stamp in m.keyframe_stamps_ns.tolist()]
    return "".join(f"M{1000 * time / parts[-1].end_s:.2f} 0V10" for time in seconds)


def _legend(run: Run) -> list[tuple[str, str, int]]:
    """CSS class, name and number of frames of each fate that occurs."""
    fates = [fate_of(f, run) for f in run.frames]
    return [(fate.name.lower(), fate.value, fates.count(fate)) for fate in Fate if fate in fates]


def _warnings(report: ReportInput) -> list[str]:
    """What a reader must know before trusting the figures."""
    m, run = report.metrics, report.run
    told: list[str] = []
    if not m["frames_tracked"]:
        reason = next((f.result.reason for f in reversed(run.frames) if f.result.reason), "")
        told.append("Nothing could be tracked" + (f". The last thing that initialisation said: {reason}" if reason else "."))
    elif m["tracked_pct"] < 50:
        told.append("Less than half of the frames have a pose in the main map; its error says nothing about the rest.")
    if m.get("ate_rel") is not None and m["ate_rel"] > 0.5:
        told.append("The error is of the size of the path itself: the trajectory is wrong, not just inexact.")
    if m["maps"] > 1:
        told.append(f"{m['maps']} maps could not be joined; figures are those of the one with most frames.")
    told += [f"Bad frames: {count} × {reason}." for reason, count in m["bad_frames"].items()]
    return told[:_MAX_LISTED]

