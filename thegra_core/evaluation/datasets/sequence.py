"""What a data set yields: sequences to run, and those that are missing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from thegra_core.outputs.trajectory import Trajectory

Pieces = Literal["bags", "whole", "windows"]
ReferenceChoice = Literal["auto", "loam", "vicon"]


@dataclass(frozen=True, slots=True)
class Reference:
    """A trajectory to score against; `source` says which one it is and how it was read."""

    trajectory: Trajectory
    source: str


@dataclass(frozen=True, slots=True)
class DataSequence:
    """One run's input.

    recording, topic, camera, start_s and duration_s are what `thegra run` takes. `row` is the sequence of the paper's tables that this is (a piece
    of). `reference` reads the ground truth (it may take a while, and raises InputError); None: there is none. `reference_files` are those beside the recording
    that it reads. `notes` tell what was decided.
    """

    name: str
    recording: Path
    topic: str | None = None
    camera: str | None = None
    reference: Callable[[], Reference] | None = None
    notes: tuple[str, ...] = ()
    row: str = ""
    start_s: float = 0.0
    duration_s: float | None = None
    reference_files: tuple[Path, ...] = ()


@dataclass(frozen=True, slots=True)
class Missing:
    """A sequence that is not there or cannot be used, and what to do about it."""

    name: str
    how_to_get: str


@dataclass(frozen=True, slots=True)
class Found:
    """What a folder holds of a data set."""

    sequences: tuple[DataSequence, ...]
    missing: tuple[Missing, ...] = ()


@dataclass(frozen=True, slots=True)
class Options:
    """How to look: `work` is a folder for what has to be made (lists of images, links); pieces and reference are for recordings in several files with several references."""

    work: Path
    pieces: Pieces = "bags"
    window_s: float = 30.0
    reference: ReferenceChoice = "auto"
    camera: str | None = None


class DataSet(Protocol):
    """Finds a data set's sequences in folders. Raises InputError if there is nothing of it."""

    def __call__(self, folders: Sequence[Path], options: Options) -> Found: ...
