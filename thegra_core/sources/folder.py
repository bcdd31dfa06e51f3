"""Folders of image files, with stamps from a list (`t path` a line) or made up at a stated rate."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path

from thegra_core.errors import InputError
from thegra_core.messages import Frame, ImageArray
from thegra_core.sources.calibration import camera_beside
from thegra_core.sources.image_decoding import DecodeError, decode_compressed
from thegra_core.sources.recording import Source

LISTS = ("images.txt", "thermal.txt", "rgb.txt")
GROUNDTRUTH = ("groundtruth.txt", "ground_truth.txt", "gt.txt")
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".webp")
ASSUMED_RATE_HZ = 10.0


@dataclass
class FolderRecording(Source):
    """Image files in order; `entries` are (stamp_ns, file)."""

    entries: list[tuple[int, Path]] = field(default_factory=list)

    def frames(self) -> Iterator[Frame]:
        """Every image that can be read; the others are counted in `problems`."""
        self.problems.clear()
        for index, (stamp_ns, file) in enumerate(self.entries):
            image = self._read(file)
            if image is not None:
                yield Frame(stamp_ns, index, image)

    def _read(self, file: Path) -> ImageArray | None:
        try:
            return decode_compressed(file.read_bytes())
        except OSError:
            self.problems["image file missing or unreadable"] += 1
        except DecodeError as error:
            self.problems[str(error)] += 1
        return None


def find_list(folder: Path) -> Path | None:
    """The list of images with stamps in a folder, if it has one."""
    return next((folder / name for name in LISTS if (folder / name).is_file()), None)


def open_list(file: Path) -> FolderRecording:
    """A folder whose `images.txt` (or TUM-style `rgb.txt`) names stamps and files.

    Raises:
        InputError: If the list names no image.
    """
    entries, bad_lines = _read_list(file)
    if not entries:
        raise InputError(f"{file} lists no images; each line must be: seconds path/of/image.png")
    recording = FolderRecording(name=file.parent.resolve().name, path=file.parent, frame_count=len(entries), entries=entries)
    if bad_lines:
        recording.note(f"{file.name}: {bad_lines} lines are not `seconds path` and were left out")
    return _with_surroundings(recording, [file.parent])


def open_images(folder: Path, rate_hz: float = ASSUMED_RATE_HZ) -> FolderRecording:
    """A folder of image files in natural order (`2.png` before `10.png`), one every 1 / rate_hz seconds from 0.

    Raises:
        InputError: If it holds no images.
    """
    files = sorted((f for f in folder.iterdir() if f.suffix.lower() in SUFFIXES and not f.name.startswith(".")), key=lambda f: natural_key(f.name))
    if not files and any(folder.glob("*.zstd")):
        raise InputError(f"{folder} holds a compressed bag without its metadata.yaml; unpack it with: zstd -d --rm {folder}/*.zstd")
    if not files:
        raise InputError(f"no recording in {folder}: it has no images.txt, no metadata.yaml, and no {' '.join(SUFFIXES)} files")
    entries = [(round(i * 1e9 / rate_hz), file) for i, file in enumerate(files)]
    recording = FolderRecording(name=folder.resolve().name, path=folder, frame_count=len(files), entries=entries)
    recording.note(f"no images.txt: stamps are made up, {rate_hz:g} images a second in the order of the file names; write `seconds path` lines to {folder / 'images.txt'} for true ones")
    return _with_surroundings(recording, [folder, folder.parent])


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key under which numbers in names count as numbers."""
    return tuple((0, int(part), "") if part.isdigit() else (1, 0, part.lower()) for part in re.split(r"(\d+)", name))


def parse_stamp(text: str) -> int:
    """Seconds, or nanoseconds when it is a whole number too large for seconds, to nanoseconds, exactly.

    Raises:
        ValueError: If it is no finite number, or no time that 64 bits of nanoseconds can hold.
    """
    try:
        value = Decimal(text)
    except InvalidOperation as error:
        raise ValueError(f"{text!r} is no time stamp") from error
    if not value.is_finite():
        raise ValueError(f"{text!r} is no time stamp")
    stamp = int(value) if "." not in text and abs(value) > 10**14 else round(value * 10**9)
    if abs(stamp) >= 2**63:
        raise ValueError(f"{text!r} is out of range for a time in seconds")
    return stamp


def _with_surroundings(recording: FolderRecording, folders: list[Path]) -> FolderRecording:
    camera, notes = camera_beside(folders)
    recording.camera = camera
    for note in notes:
        recording.note(note)
    recording.groundtruth = next((folder / name for folder in folders for name in GROUNDTRUTH if (folder / name).is_file()), None)
    return recording


def _read_list(file: Path) -> tuple[list[tuple[int, Path]], int]:
    entries: list[tuple[int, Path]] = []
    bad = 0
    for line in file.read_text(encoding="utf-8-sig", errors="replace").splitlines():
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        stamp, *name = re.split(r"\s*,\s*|\s+", line, maxsplit=1)
        try:
            entries.append((parse_stamp(stamp), file.parent / name[0]))
        except (ValueError, IndexError):
            bad += 1
    return entries, bad
