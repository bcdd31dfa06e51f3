"""KITTI odometry (Geiger et al. 2012): `sequences/NN/{image_0,times.txt,calib.txt}` and `poses/NN.txt`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from thegra_core.errors import InputError
from thegra_core.evaluation.datasets.below import below
from thegra_core.evaluation.datasets.pose_table import read_pose_table
from thegra_core.evaluation.datasets.sequence import DataSequence, Found, Missing, Options, Reference
from thegra_core.evaluation.datasets.staging import camera_file, image_list, image_size
from thegra_core.messages import IntArray
from thegra_core.outputs.trajectory import parse_stamp
from thegra_core.sources.folder import natural_key


def find_kitti(folders: Sequence[Path], options: Options) -> Found:
    """Every folder with `image_0`, at any depth.

    Raises:
        InputError: If there is none.
    """
    homes = sorted({p.parent for p in below(folders) if p.name == "image_0" and p.is_dir()}, key=lambda p: natural_key(str(p)))
    if not homes:
        raise InputError(f"no image_0 in {', '.join(map(str, folders))}; get the odometry data set (grayscale, calibration, poses) at cvlibs.net/datasets/kitti")
    found, missing = [], []
    for home in homes:
        try:
            found.append(_sequence(home, options))
        except InputError as error:
            missing.append(Missing(home.resolve().name, str(error)))
    return Found(tuple(found), tuple(missing))


def _sequence(home: Path, options: Options) -> DataSequence:
    name = home.resolve().name
    images = sorted((home / "image_0").glob("*.png"), key=lambda p: natural_key(p.name))
    stamps = _times(home / "times.txt")
    if len(images) != len(stamps) or not images:
        raise InputError(f"{home} has {len(images)} images but {len(stamps)} times; unpack the archives again")
    camera = options.camera or str(camera_file(options.work / name / "camera.yaml", _intrinsics(home / "calib.txt"), [0.0] * 5, "plumb_bob", image_size(images[0])))
    recording = image_list(options.work / name, zip(stamps.tolist(), images, strict=True))
    poses = next((p for p in (home.parent / "poses" / f"{name}.txt", home.parent.parent / "poses" / f"{name}.txt", home / "poses.txt") if p.is_file()), None)
    reference = None if poses is None else partial(_reference, poses, stamps)
    notes = (f"camera {camera}", *(() if poses else (f"no ground truth: no poses/{name}.txt; coverage only",)))
    return DataSequence(name, recording, None, camera, reference, notes, row=name, reference_files=(poses, home / "times.txt") if poses else ())


def _times(file: Path) -> IntArray:
    try:
        return np.array([parse_stamp(line.strip()) for line in file.read_text(encoding="utf-8").splitlines() if line.strip()], np.int64)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot use {file}: {error}; expected seconds, a line an image") from error


def _intrinsics(file: Path) -> list[float]:
    """fx, fy, cx, cy of the rectified left camera, `P0: 12 numbers`."""
    try:
        line = re.search(r"^P0:(.*)$", file.read_text(encoding="utf-8"), re.MULTILINE)
        values = [float(word) for word in line[1].split()] if line else []
    except (OSError, ValueError) as error:
        raise InputError(f"cannot use {file}: {error}") from error
    if len(values) != 12:
        raise InputError(f"{file} has no line `P0:` with 12 numbers")
    return [values[0], values[5], values[2], values[6]]


def _reference(poses: Path, stamps: IntArray) -> Reference:
    table = read_pose_table(poses, stamps[: sum(1 for line in poses.read_text(encoding="utf-8").splitlines() if line.strip())])
    return Reference(table.trajectory, f"table {table.decision}")
