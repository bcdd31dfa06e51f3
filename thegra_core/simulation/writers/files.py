"""The text files beside a recording: ground truth, camera, shutter."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from thegra_core.geometry.camera import CameraModel
from thegra_core.outputs.trajectory import format_stamp, format_tum, make_trajectory
from thegra_core.simulation.recording import Simulated

FloatArray = NDArray[np.float64]


def write_beside(folder: Path, recording: Simulated, truth: Iterable[tuple[int, FloatArray]]) -> None:
    """Write `groundtruth.txt` (TUM), `camera.yaml` and `shutter.txt`, each where there is something to tell."""
    poses = make_trajectory(truth)
    if len(poses):
        text = "# stamp tx ty tz qx qy qz qw (world_from_camera, metres)\n" + format_tum(poses)
        (folder / "groundtruth.txt").write_text(text, encoding="utf-8")
    if recording.camera is not None:
        (folder / "camera.yaml").write_text(camera_yaml(recording.camera), encoding="utf-8")
    if recording.closures_ns:
        (folder / "shutter.txt").write_text(shutter_text(recording.closures_ns), encoding="utf-8")


def shutter_text(closures_ns: Iterable[tuple[int, int]]) -> str:
    """Lines `begin end` in seconds: the first blind frame, and the first that sees again."""
    return "".join(f"{format_stamp(begin)} {format_stamp(end)}\n" for begin, end in closures_ns)


def camera_yaml(camera: CameraModel) -> str:
    """A camera as the YAML file that ROS's camera_calibration writes."""
    width, height = camera.image_size
    values = {
        "image_width": width,
        "image_height": height,
        "camera_name": camera.name or "thermal_camera",
        "camera_matrix": _matrix(camera.matrix),
        "distortion_model": camera.model.value,
        "distortion_coefficients": _matrix(camera.distortion[None]),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(projection(camera)),
    }
    return str(yaml.safe_dump(values, sort_keys=False, default_flow_style=None))


def projection(camera: CameraModel) -> FloatArray:
    """CameraInfo's P (3, 4) of a camera that is not rectified."""
    return np.concatenate([camera.matrix, np.zeros((3, 1))], axis=1)


def _matrix(values: FloatArray) -> dict[str, Any]:
    return {"rows": values.shape[0], "cols": values.shape[1], "data": [float(v) for v in values.ravel()]}
