"""Map files: all that mapping knows of one map, so that it can go on in it another day."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thegra_core.config import ThegraConfig
from thegra_core.errors import InputError
from thegra_core.geometry.camera import CameraModel
from thegra_core.map.archive import Arrays, read_archive, write_archive
from thegra_core.map.editor import MapEditor
from thegra_core.map.file import camera_header, camera_of, map_arrays, restore_map
from thegra_core.mapping.chaining import MatchGraph
from thegra_core.places.index import PlaceIndex
from thegra_core.version import VERSION

FORMAT = "thegra map"
FORMAT_VERSION = 1
_SAME_CAMERA = 1e-6


@dataclass(frozen=True, slots=True)
class KeptMap:
    """A map with what belongs to it: the matches of its keyframes, its places, and the landmarks that are still on trial."""

    editor: MapEditor
    graph: MatchGraph
    index: PlaceIndex
    trial: list[int]


def save_map(path: Path, kept: KeptMap, config: ThegraConfig) -> None:
    """Write a map file, atomically.

    Raises:
        InputError: If it cannot be written.
    """
    current = kept.editor.map
    header = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "thegra": VERSION,
        "extractor": config.extractor.name,
        "camera": camera_header(current.camera),
        "keyframes": len(current.keyframes),
        "landmarks": len(current.landmarks),
    }
    parts = {"graph": kept.graph.arrays(), "places": kept.index.arrays(), "trial": {"ids": np.array(kept.trial, dtype=np.int64)}}
    joined = {f"{part}/{name}": values for part, arrays in parts.items() for name, values in arrays.items()}
    write_archive(path, header, map_arrays(kept.editor) | joined)


def load_map(path: Path, map_id: int, camera: CameraModel, config: ThegraConfig, index: PlaceIndex) -> KeptMap:
    """Read a map file; `index` takes its places.

    Raises:
        InputError: If the file is not there, not whole, or of another version, camera or extractor.
    """
    header, arrays = read_archive(path)
    _check(path, header, camera, config)
    try:
        editor = restore_map(arrays, map_id, camera, config.extractor.name, config.mapping.covisibility_threshold)
        graph = MatchGraph.restored(_part(arrays, "graph"), {i: k.stamp_ns for i, k in editor.map.keyframes.items()})
        index.restore(_part(arrays, "places"), {i: k.features for i, k in sorted(editor.map.keyframes.items())})
        return KeptMap(editor, graph, index, arrays["trial/ids"].tolist())
    except (KeyError, IndexError, ValueError) as error:
        raise InputError(f"{path} does not fit together ({error}): make the map anew") from error


def _part(arrays: Arrays, name: str) -> Arrays:
    return {key.removeprefix(f"{name}/"): values for key, values in arrays.items() if key.startswith(f"{name}/")}


def _check(path: Path, header: dict[str, Any], camera: CameraModel, config: ThegraConfig) -> None:
    if header.get("format") != FORMAT:
        raise InputError(f"{path} is no map file of Thegra")
    if header.get("format_version") != FORMAT_VERSION:
        raise InputError(
            f"{path} has version {header.get('format_version')} of the map format, written by thegra {header.get('thegra')}; "
            f"this is thegra {VERSION}, which reads version {FORMAT_VERSION}: make the map anew, or use that release"
        )
    if header.get("extractor") != config.extractor.name:
        raise InputError(
            f"{path} was made with {header.get('extractor')} features, this run uses {config.extractor.name}: "
            f"give the profile that the map was made with, or --set extractor.name={header.get('extractor')}"
        )
    theirs = camera_of(header["camera"])
    if theirs.image_size != camera.image_size or theirs.model != camera.model or not _same(theirs, camera):
        raise InputError(
            f"{path} was made with another camera: {_describe(theirs)} there, {_describe(camera)} here; "
            "give that calibration with --camera, or make a map of this camera"
        )


def _same(one: CameraModel, other: CameraModel) -> bool:
    return bool(
        one.distortion.shape == other.distortion.shape
        and np.allclose(one.matrix, other.matrix, rtol=_SAME_CAMERA)
        and np.allclose(one.distortion, other.distortion, atol=_SAME_CAMERA)
    )


def _describe(camera: CameraModel) -> str:
    width, height = camera.image_size
    fx, fy, cx, cy = (camera.matrix[row, column] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return f"{width}x{height} {camera.model.value} fx {fx:.2f} fy {fy:.2f} cx {cx:.2f} cy {cy:.2f}"
