"""Files that are either whole or not there."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from thegra_core.errors import InputError

_CHUNK = 1 << 20


@contextmanager
def writing_to(folder: Path) -> Iterator[None]:
    """Make the folder if it is not there; what cannot be written while the context lasts is told as such.

    Raises:
        InputError: If something cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise InputError(f"cannot write to {folder}: {error.strerror or error}; choose another folder with --out DIR") from error


def write_atomic(path: Path, content: str | bytes) -> Path:
    """Write beside `path` and rename over it, so that a reader or a crash never meets half a file."""
    data = content.encode("utf-8") if isinstance(content, str) else content
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def sha256_of(path: Path, without: Path | None = None) -> str:
    """SHA-256 of a file; of a folder, that over its files' relative names and contents in sorted order, leaving out the folder `without`."""
    digest = hashlib.sha256()
    if path.is_file():
        _feed(digest, path)
        return digest.hexdigest()
    left_out = without.resolve() if without is not None else None
    for file in sorted(p for p in path.rglob("*") if p.is_file()):
        if left_out is not None and file.resolve().is_relative_to(left_out):
            continue
        digest.update(f"{file.relative_to(path).as_posix()}\0{file.stat().st_size}\0".encode())
        _feed(digest, file)
    return digest.hexdigest()


def _feed(digest: hashlib._Hash, file: Path) -> None:
    with file.open("rb") as stream:
        while chunk := stream.read(_CHUNK):
            digest.update(chunk)
