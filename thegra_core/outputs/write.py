"""Turns a finished run into its folder of files."""

from __future__ import annotations

import importlib.metadata
import json
import logging
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from thegra_core.config import RUN_FACTS, ThegraConfig, dump_config
from thegra_core.errors import InputError
from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import Float32Array, FloatArray, Run
from thegra_core.outputs.files import sha256_of, write_atomic, writing_to
from thegra_core.outputs.metrics import RunScores, Timing, run_metrics, score_run
from thegra_core.outputs.pointcloud import format_ply
from thegra_core.outputs.trajectory import (
    Trajectory,
    final_trajectory,
    format_tum,
    keyframe_trajectory,
    live_trajectory,
    predicted_trajectory,
    read_tum,
)
from thegra_core.version import VERSION

_log = logging.getLogger(__name__)
_DISTRIBUTIONS = ("numpy", "scipy", "opencv-python-headless", "torch", "kornia", "gtsam", "poselib", "pydantic")


@dataclass(frozen=True, slots=True)
class RecordingFacts:
    """What was run on, and with which networks: `weights` maps a file to its sha256, `problems` a reason to the images that could not be read."""

    name: str
    path: Path
    topic: str | None
    camera: CameraModel
    weights: Mapping[str, str] = field(default_factory=dict)
    problems: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    command: str = ""
    started_utc: str = ""


@dataclass(frozen=True, slots=True)
class WrittenRun:
    """Where the files are, and the figures in `metrics.json`."""

    folder: Path
    metrics: dict[str, Any]
    files: tuple[Path, ...]

    @property
    def report(self) -> Path:
        return self.folder / "report.html"


def write_run(run: Run, out_dir: Path, config: ThegraConfig, recording: RecordingFacts, groundtruth: Path | None, timing: Timing) -> WrittenRun:
    """Write every file of a run, each atomically; the figures come before the report, so that a failure in drawing loses no data.

    Raises:
        InputError: If the folder cannot be written or the ground truth cannot be read (after everything that needs none is written).
    """
    with writing_to(out_dir):
        files = [*_write_trajectories(run, out_dir), _write_points(run, out_dir)]
        files.append(write_atomic(out_dir / "config.yaml", run_config(config, recording, out_dir)))
        truth, problem = _read_groundtruth(groundtruth)
        scores = score_run(run, truth) if truth is not None else None
        metrics = run_metrics(run, config, timing, scores, recording.problems)
        files.append(write_atomic(out_dir / "metrics.json", json.dumps(metrics, indent=2, allow_nan=False) + "\n"))
        files.extend(_write_report(run, out_dir, config, recording, metrics, truth, scores))
    if problem is not None:
        raise problem
    return WrittenRun(out_dir, metrics, tuple(files))


def run_config(config: ThegraConfig, recording: RecordingFacts, out_dir: Path | None = None) -> str:
    """The configuration as YAML that `--config` reads back, and under `run` what else is needed to repeat the run.

    The input's checksum leaves out `out_dir`, which may lie inside the input.
    """
    camera = recording.camera
    facts = {
        "version": VERSION,
        "started_utc": recording.started_utc,
        "command": recording.command,
        "input": {"name": recording.name, "path": str(recording.path), "topic": recording.topic, "sha256": _input_sha256(recording.path, out_dir)},
        "camera": {
            "model": camera.model.value,
            "image_size": list(camera.image_size),
            "matrix": np.asarray(camera.matrix).tolist(),
            "distortion": np.asarray(camera.distortion).tolist(),
        },
        "seed": config.seed,
        "weights_sha256": dict(recording.weights),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": installed_versions(_DISTRIBUTIONS),
    }
    return dump_config(config) + str(yaml.safe_dump({RUN_FACTS: facts}, sort_keys=False))


def installed_versions(distributions: tuple[str, ...]) -> dict[str, str | None]:
    """Version of each distribution, None where it is not installed."""
    return {name: _version_of(name) for name in distributions}


def _version_of(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _write_trajectories(run: Run, out_dir: Path) -> list[Path]:
    for stale in [*out_dir.glob("trajectory_map*.txt"), *out_dir.glob("predicted*.txt")]:
        stale.unlink()
    contents: dict[str, Trajectory] = {
        "trajectory.txt": final_trajectory(run, run.main_map_id),
        "trajectory_live.txt": live_trajectory(run, run.main_map_id),
        "keyframes.txt": keyframe_trajectory(run, run.main_map_id),
    }
    others = sorted({f.map_id for f in run.frames if f.world_from_camera is not None} - {run.main_map_id})
    contents |= {f"trajectory_map{k}.txt": final_trajectory(run, k) for k in others}
    for map_id in sorted({f.result.map_id for f in run.frames if f.predicted is not None}):
        contents["predicted.txt" if map_id == run.main_map_id else f"predicted_map{map_id}.txt"] = predicted_trajectory(run, map_id)
    return [write_atomic(out_dir / name, format_tum(trajectory)) for name, trajectory in contents.items()]


def _write_points(run: Run, out_dir: Path) -> Path:
    main = next((m for m in run.maps if m.map_id == run.main_map_id), None)
    points: FloatArray = main.points_world if main else np.empty((0, 3))
    scores: Float32Array = main.point_scores if main else np.empty(0, np.float32)
    return write_atomic(out_dir / "map.ply", format_ply(points, scores))


def _write_report(
    run: Run, out_dir: Path, config: ThegraConfig, recording: RecordingFacts, metrics: dict[str, Any], truth: Trajectory | None, scores: RunScores | None
) -> list[Path]:
    """The page, and the picture where there is a map."""
    from thegra_core.outputs.report.build import ReportInput, build_report, run_poses  # matplotlib and jinja2 take a second to import
    from thegra_core.outputs.report.overview import overview

    report = ReportInput(
        run=run,
        config=config,
        metrics=metrics,
        name=recording.name,
        path=str(recording.path),
        topic=recording.topic,
        image_size=recording.camera.image_size,
        problems=recording.problems,
        notes=recording.notes,
        command=recording.command,
        started_utc=recording.started_utc,
        groundtruth=truth,
        scores=scores,
    )
    files = [write_atomic(out_dir / "report.html", build_report(report))]
    poses = run_poses(report)
    picture = out_dir / "overview.png"
    if poses is None:
        picture.unlink(missing_ok=True)
        return files
    alignment = scores.final.alignment if scores is not None else None
    return [*files, write_atomic(picture, overview(run, poses, alignment, "m" if poses.groundtruth is not None else "map units"))]


def _read_groundtruth(path: Path | None) -> tuple[Trajectory | None, InputError | None]:
    if path is None:
        return None, None
    try:
        return read_tum(path), None
    except InputError as error:
        return None, error


def _input_sha256(path: Path, out_dir: Path | None) -> str | None:
    try:
        return sha256_of(path, without=out_dir)
    except OSError as error:
        _log.warning("the input's checksum is missing from config.yaml: %s", error)
        return None
