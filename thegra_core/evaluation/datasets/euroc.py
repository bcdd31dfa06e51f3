"""EuRoC MAV (Burri et al. 2016) and what has its form: `mav0/cam0` and `mav0/state_groundtruth_estimate0`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from thegra_core.errors import InputError
from thegra_core.evaluation.datasets.below import below
from thegra_core.evaluation.datasets.pose_table import read_pose_table
from thegra_core.evaluation.datasets.sequence import DataSequence, Found, Missing, Options, Reference
from thegra_core.evaluation.datasets.staging import camera_file, image_list, moved
from thegra_core.messages import FloatArray
from thegra_core.outputs.trajectory import Trajectory
from thegra_core.sources.folder import natural_key, parse_stamp

_TRUTH = ("state_groundtruth_estimate0", "mocap0", "leica0")
_MODELS = {"radial-tangential": "plumb_bob", "radtan": "plumb_bob", "equidistant": "equidistant"}


def find_euroc(folders: Sequence[Path], options: Options) -> Found:
    """Every `mav0` below some folders; a sequence is called as the folder it lies in.

    Raises:
        InputError: If there is none.
    """
    homes = sorted({p for p in [*folders, *below(folders)] if p.name == "mav0" and (p / "cam0").is_dir()}, key=lambda p: natural_key(str(p)))
    if not homes:
        raise InputError(f"no mav0/cam0 in {', '.join(map(str, folders))}; get the ASL archives at projects.asl.ethz.ch/datasets and unpack them")
    found, missing = [], []
    for home in homes:
        try:
            found.append(_sequence(home, options))
        except InputError as error:
            missing.append(Missing(home.resolve().parent.name, str(error)))
    return Found(tuple(found), tuple(missing))


def _sequence(home: Path, options: Options) -> DataSequence:
    name, cam = home.resolve().parent.name, home / "cam0"
    sensor = _sensor(cam / "sensor.yaml")
    camera = options.camera or str(_camera(sensor, cam / "sensor.yaml", options.work / name / "camera.yaml"))
    recording = image_list(options.work / name, _images(cam))
    truth = next((home / folder / "data.csv" for folder in _TRUTH if (home / folder / "data.csv").is_file()), None)
    reference = None if truth is None else partial(_reference, truth, _body_from_camera(sensor))
    notes = (f"camera {camera}", *(() if truth else (f"no ground truth: none of {', '.join(_TRUTH)}; coverage only",)))
    return DataSequence(name, recording, None, camera, reference, notes, row=name, reference_files=(truth, cam / "sensor.yaml") if truth else ())


def _images(cam: Path) -> list[tuple[int, Path]]:
    """Stamps and files of `data.csv`."""
    try:
        lines = (cam / "data.csv").read_text(encoding="utf-8").splitlines()
        cells = [line.split(",") for line in lines if line.strip() and not line.startswith("#")]
        return [(parse_stamp(row[0].strip()), cam / "data" / row[1].strip()) for row in cells]
    except (OSError, ValueError, IndexError) as error:
        raise InputError(f"cannot use {cam / 'data.csv'}: {error}; expected `stamp in ns,file` lines") from error


def _sensor(file: Path) -> dict[str, Any]:
    try:
        values = yaml.safe_load(file.read_text(encoding="utf-8").replace("%YAML:1.0", ""))
    except (OSError, yaml.YAMLError) as error:
        raise InputError(f"cannot read {file}: {error}") from error
    if not isinstance(values, dict) or not {"intrinsics", "resolution", "distortion_model"} <= values.keys():
        raise InputError(f"{file} does not tell intrinsics, resolution and distortion_model")
    return values


def _camera(sensor: dict[str, Any], file: Path, target: Path) -> Path:
    model = _MODELS.get(str(sensor["distortion_model"]))
    if model is None:
        raise InputError(f"{file}: unknown distortion_model {sensor['distortion_model']!r}; known: {', '.join(_MODELS)}")
    width, height = sensor["resolution"]
    return camera_file(target, sensor["intrinsics"], sensor.get("distortion_coefficients", []), model, (int(width), int(height)))


def _body_from_camera(sensor: dict[str, Any]) -> FloatArray | None:
    """T_BS: the camera on the body that the ground truth tells of."""
    data = sensor.get("T_BS", {}).get("data")
    return None if data is None else np.asarray(data, np.float64).reshape(4, 4)


def _reference(file: Path, body_from_camera: FloatArray | None) -> Reference:
    table = read_pose_table(file)
    if body_from_camera is None:
        return Reference(table.trajectory, f"table {table.decision}; of the body: sensor.yaml tells no T_BS")
    poses = moved(table.trajectory.poses, body_from_camera)
    return Reference(Trajectory(table.trajectory.stamps_ns, poses), f"table {table.decision}; moved to the camera by T_BS")
