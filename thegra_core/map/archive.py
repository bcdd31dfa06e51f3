"""Named arrays and a header in one compressed file that is either whole or not there."""

from __future__ import annotations

import contextlib
import json
import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thegra_core.errors import InputError

Arrays = dict[str, NDArray[Any]]

_HEADER = "header.json"
_LEVEL = 1  # of deflate: more gains little, and a robot waits
_SAMPLE_BYTES = 1 << 16
_WORTH = 0.8


def write_archive(path: Path, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write a zip of `header.json` and one `.npy` an array; a process killed at any moment leaves what was at `path` before, or all of the new file.

    Raises:
        InputError: If the folder cannot be written to.
    """
    part = path.with_name(f".{path.name}.part")  # the same name each time: what a killed process left is overwritten
    try:
        with part.open("wb") as stream:
            with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=_LEVEL) as archive:
                with archive.open(_HEADER, "w") as member:
                    member.write(json.dumps(dict(header), indent=1, sort_keys=True).encode())
                for name, values in arrays.items():
                    info = zipfile.ZipInfo(f"{name}.npy")  # with the date that all zip files begin at: the same content gives the same bytes
                    info.compress_type = zipfile.ZIP_DEFLATED if _compresses(values) else zipfile.ZIP_STORED
                    with archive.open(info, "w", force_zip64=True) as member:
                        np.lib.format.write_array(member, np.ascontiguousarray(values), allow_pickle=False)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)


def read_header(path: Path) -> dict[str, Any]:
    """The header alone.

    Raises:
        InputError: If there is no such file, or it is none of ours, or damaged.
    """
    with _opened(path) as archive:
        return _header(path, archive)


def read_archive(path: Path) -> tuple[dict[str, Any], Arrays]:
    """Header and arrays; every byte is checked against the checksums in the file.

    Raises:
        InputError: If there is no such file, or it is none of ours, or damaged.
    """
    arrays: Arrays = {}
    with _opened(path) as archive:
        header = _header(path, archive)
        for name in archive.namelist():
            if name.endswith(".npy"):
                with archive.open(name) as member:
                    arrays[name.removesuffix(".npy")] = np.lib.format.read_array(member, allow_pickle=False)
    return header, arrays


@contextlib.contextmanager
def _opened(path: Path) -> Any:
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except FileNotFoundError as error:
        raise InputError(f"there is no map file {path}") from error
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, KeyError) as error:
        raise InputError(f"{path} is no whole map file ({error}): it was cut short or changed after it was written; make the map anew") from error
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error


def _header(path: Path, archive: zipfile.ZipFile) -> dict[str, Any]:
    header = json.loads(archive.read(_HEADER))
    if not isinstance(header, dict):
        raise InputError(f"{path} is a zip file but no map file")
    return header


def _compresses(values: NDArray[Any]) -> bool:
    """Whether deflate makes less of an array, by a sample of it: descriptors, which are most of a map, are nearly random numbers."""
    sample = np.ascontiguousarray(values).reshape(-1)[: max(1, _SAMPLE_BYTES // max(values.itemsize, 1))].tobytes()
    return len(zlib.compress(sample, _LEVEL)) < _WORTH * len(sample)


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
