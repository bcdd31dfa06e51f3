"""Inputs in the form that `thegra run` takes, made from files that stay where they are."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import yaml

import thegra_core
from thegra_core.errors import InputError
from thegra_core.messages import FloatArray
from thegra_core.outputs.files import write_atomic
from thegra_core.outputs.trajectory import format_stamp


def camera_preset(name: str) -> str:
    """Path of a calibration in `config/cameras`, of the repository or of an installation.

    Raises:
        InputError: If it is in neither.
    """
    roots = [Path(thegra_core.__file__).resolve().parents[1] / "config", Path(sys.prefix) / "share" / "thegra_ros" / "config"]
    files = [root / "cameras" / f"{name}.yaml" for root in roots]
    found = next((file for file in files if file.is_file()), None)
    if found is None:
        raise InputError(f"the calibration {name}.yaml is in none of {', '.join(str(f.parent) for f in files)}; give one with --camera FILE")
    return str(found)


def image_list(folder: Path, entries: Iterable[tuple[int, Path]]) -> Path:
    """A recording of image files that stay where they are: a folder with an `images.txt` of absolute paths."""
    folder.mkdir(parents=True, exist_ok=True)
    _write(folder / "images.txt", "".join(f"{format_stamp(stamp)} {file.resolve()}\n" for stamp, file in entries))
    return folder


def linked_bags(folder: Path, bags: Sequence[Path]) -> Path:
    """A folder of links to bag files, named so that their order is the order given."""
    if folder.is_dir():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    for i, bag in enumerate(bags):
        (folder / f"{i:04d}_{bag.name}").symlink_to(bag.resolve())
    return folder


def camera_file(file: Path, matrix: Sequence[float], distortion: Sequence[float], model: str, size: tuple[int, int]) -> Path:
    """A camera in the form of ROS's camera_info files; matrix is fx, fy, cx, cy."""
    fx, fy, cx, cy = (float(v) for v in matrix)
    values = {
        "image_width": size[0],
        "image_height": size[1],
        "camera_name": file.stem,
        "distortion_model": model,
        "camera_matrix": {"rows": 3, "cols": 3, "data": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]},
        "distortion_coefficients": {"rows": 1, "cols": len(distortion), "data": [float(v) for v in distortion]},
    }
    file.parent.mkdir(parents=True, exist_ok=True)
    return _write(file, str(yaml.safe_dump(values, sort_keys=False)))


def image_size(file: Path) -> tuple[int, int]:
    """(width, height) of an image file.

    Raises:
        InputError: If it is none.
    """
    from thegra_core.sources.image_decoding import DecodeError, decode_compressed

    try:
        height, width = decode_compressed(file.read_bytes()).shape
    except (OSError, DecodeError) as error:
        raise InputError(f"cannot read the image {file}: {error}") from error
    return width, height


def moved(poses: FloatArray, body_from_camera: FloatArray) -> FloatArray:
    """world_from_camera (N, 4, 4) of world_from_body and the camera's place on it."""
    return poses @ body_from_camera


def _write(file: Path, content: str) -> Path:
    """Leaves a file with that content alone: a run is done again when its input is newer."""
    if file.is_file() and file.read_text(encoding="utf-8") == content:
        return file
    return write_atomic(file, content)
