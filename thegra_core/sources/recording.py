"""What every kind of recording offers, and the bookkeeping its readers share."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import Frame


class Recording(Protocol):
    """A stream of images on disk.

    `frames()` reads from the beginning at each call, in the order of the file; stamps may repeat or go back. `frame_count` is None where
    only reading would tell; it and `Frame.index` count stored images, damaged ones too. `problems` counts reasons, and is complete when `frames()` has ended.
    """

    @property
    def name(self) -> str: ...
    @property
    def path(self) -> Path: ...
    @property
    def topic(self) -> str | None: ...
    @property
    def camera(self) -> CameraModel | None: ...
    @property
    def frame_count(self) -> int | None: ...
    @property
    def groundtruth(self) -> Path | None: ...
    @property
    def problems(self) -> Mapping[str, int]: ...
    @property
    def notes(self) -> list[str]: ...
    def frames(self) -> Iterator[Frame]: ...


@dataclass
class Source:
    """The plain fields of a recording; each reader adds `frames`."""

    name: str
    path: Path
    topic: str | None = None
    camera: CameraModel | None = None
    frame_count: int | None = None
    groundtruth: Path | None = None
    problems: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)

    def note(self, text: str) -> None:
        """Add a note once, however often the recording is read."""
        if text not in self.notes:
            self.notes.append(text)


@dataclass(frozen=True, slots=True)
class ImageTopic:
    """An image topic of a bag: message type, number of messages (None: not indexed), and of its first image encoding and (width, height)."""

    name: str
    type: str
    count: int | None
    encoding: str = ""
    size: tuple[int, int] | None = None
    compressed: bool = False

    def __str__(self) -> str:
        count = "?" if self.count is None else str(self.count)
        size = f" {self.size[0]}x{self.size[1]}" if self.size else ""
        return f"{self.name}  {self.type.rsplit('/', 1)[-1]}, {count} messages{size} {self.encoding}".rstrip()
