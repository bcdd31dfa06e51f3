"""Any recordings, as YAML lists: input, topic, camera file, ground truth file."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from thegra_core.errors import InputError
from thegra_core.evaluation.datasets.bag_poses import read_bag_poses
from thegra_core.evaluation.datasets.pose_table import read_pose_table
from thegra_core.evaluation.datasets.sequence import DataSequence, Found, Missing, Options, Reference

EXAMPLE = """- input: flights/one.bag          # what `thegra run` takes; paths count from this file
  topic: /thermal/image_raw      # optional, as all that follows
  camera: camera.yaml
  groundtruth: one_truth.csv     # a table of poses, or a topic of the input: /vicon/rig
  name: one
  start: 0
  duration: 60"""


class Entry(BaseModel):
    """One recording of the list."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    input: str
    topic: str | None = None
    camera: str | None = None
    groundtruth: str | None = None
    name: str | None = None
    start: float = Field(0.0, ge=0)
    duration: float | None = Field(None, gt=0)


def find_generic(folders: Sequence[Path], options: Options) -> Found:
    """The recordings of some YAML lists (or of the `recordings.yaml` of folders); those whose files are not there are missing.

    Raises:
        InputError: If a list cannot be read, with an example of one, or two recordings have the same name.
    """
    found: list[DataSequence] = []
    missing: list[Missing] = []
    for place in folders:
        file = place / "recordings.yaml" if place.is_dir() else place
        for entry in _entries(file):
            sequence = _sequence(entry, file.parent, options)
            if isinstance(sequence, Missing):
                missing.append(sequence)
            else:
                found.append(sequence)
    names = [s.name for s in found]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"two recordings are called {twice}; give them a `name` each")
    return Found(tuple(found), tuple(missing))


def _entries(file: Path) -> list[Entry]:
    try:
        values: Any = yaml.safe_load(file.read_text(encoding="utf-8"))
        return TypeAdapter(list[Entry]).validate_python(values)
    except (OSError, yaml.YAMLError) as error:
        raise InputError(f"cannot read {file}: {error}; write a list like\n{EXAMPLE}") from error
    except ValidationError as error:
        told = "\n".join(f"  {'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise InputError(f"{file} is no list of recordings:\n{told}\nwrite one like\n{EXAMPLE}") from error


def _sequence(entry: Entry, base: Path, options: Options) -> DataSequence | Missing:
    recording = base / entry.input
    name = entry.name or recording.stem
    camera = options.camera or (None if entry.camera is None else str((base / entry.camera).absolute()))
    truth = entry.groundtruth
    topic = truth is not None and truth.startswith("/") and not Path(truth).is_file()
    absent = [path for path in (recording, *([] if truth is None or topic else [base / truth])) if not path.exists()]
    if absent:
        return Missing(name, f"{absent[0]} does not exist; correct the list")
    reference = None
    if truth is not None:
        reference = partial(read_bag_poses, [recording], truth, "topic") if topic else partial(_from_table, base / truth)
    notes = (f"camera {camera or 'of the recording'}", *((f"reference {truth}",) if truth else ("no ground truth given; coverage only",)))
    files = () if truth is None or topic else (base / truth,)
    return DataSequence(name, recording, entry.topic, camera, reference, notes, name, entry.start, entry.duration, files)


def _from_table(file: Path) -> Reference:
    table = read_pose_table(file)
    return Reference(table.trajectory, f"table {table.decision}")
