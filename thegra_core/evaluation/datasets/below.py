"""What lies in folders, however deep, also behind links: data sets are large, and often linked to where there is room."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path


def below(folders: Iterable[Path]) -> list[Path]:
    """Files and folders below some folders, without these; a folder that several paths lead to is met once."""
    seen: set[str] = set()
    return [path for folder in folders for path in _below(folder, seen)]


def _below(folder: Path, seen: set[str]) -> Iterator[Path]:
    for place, names, files in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        if real in seen:
            names.clear()
            continue
        seen.add(real)
        yield from (Path(place) / name for name in (*names, *files))
