"""Bag files as streams of serialised messages: through their index where it is sound, else by walking over what is there.

rosbags reads ROS 1 bags, rosbag2 folders, mcap and db3. Files that it refuses (never closed, cut short, index lost) are walked record by record.
"""

from __future__ import annotations

import contextlib
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.exceptions import EndOfFile
from rosbags import rosbag1, rosbag2

from thegra_core.errors import InputError
from thegra_core.sources.bag_walks import RawMessage, Walk, db3_is_short, walk_db3, walk_mcap, walk_ros1
from thegra_core.sources.folder import natural_key


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag file; count None: unknown without reading."""

    name: str
    type: str
    count: int | None


@dataclass
class BagFile:
    """One bag file, or one rosbag2 folder with sound metadata; `damage` says what is wrong with it."""

    path: Path
    topics: list[Topic]
    damage: str = ""
    walk: Walk | None = None
    problems: Counter[str] = field(default_factory=Counter)

    def messages(self, *topics: str) -> Iterator[RawMessage]:
        """The messages of some topics in the file's order; where the file breaks off, the reason is counted in `problems`."""
        self.problems.clear()
        if self.damage:
            self.problems[self.damage] += 1
        stream = self._indexed(topics) if self.walk is None else (m for m in self.walk(self.path) if m.topic in topics)
        try:
            yield from stream
        except Exception as error:  # what is damaged decides what the libraries raise
            self.problems[f"{self.path.name} breaks off: {_reason(error)}"] += 1

    def _indexed(self, topics: tuple[str, ...]) -> Iterator[RawMessage]:
        with _reader(self.path) as reader:
            connections = [c for c in reader.connections if c.topic in topics]
            if connections:
                for connection, _, data in reader.messages(connections):
                    yield RawMessage(connection.topic, connection.msgtype, bytes(data), isinstance(reader, rosbag1.Reader))


def is_bag(path: Path) -> bool:
    """Whether a file starts like a ROS 1 bag, an mcap or an SQLite file."""
    return _kind(path) is not None


def open_bag_files(path: Path) -> list[BagFile]:
    """The bag files of a path, in order: one for a file or a sound rosbag2 folder, one each for split or orphaned files in a folder.

    Raises:
        InputError: If there is nothing to read at all.
    """
    if path.is_file():
        return [_open_file(path)]
    files = [f for f in path.iterdir() if f.is_file() and is_bag(f)]
    damage = "metadata.yaml missing: the recorder was not ended properly"
    if (path / "metadata.yaml").is_file():
        try:
            return [BagFile(path, _indexed_topics(path))]
        except Exception as error:  # what is damaged decides what rosbags raises
            damage = f"rosbag2 folder damaged: {_reason(error)}"
    if not files:
        raise InputError(f"{path} holds no bag that can be read ({damage})")
    bags = [_open_file(file) for file in sorted(files, key=lambda f: natural_key(f.name))]
    if _kind(files[0]) != "bag":
        bags[0].damage = bags[0].damage or damage
    return bags


def _open_file(path: Path) -> BagFile:
    kind = _kind(path)
    if kind is None:
        raise InputError(f"{path} is {'empty' if path.stat().st_size == 0 else 'no bag: it starts like none'}; give a ROS 1 .bag, a rosbag2 folder, .mcap or .db3")
    try:
        topics = _indexed_topics(path)
        if kind != "db3" or not db3_is_short(path):
            return BagFile(path, topics, _unmerged_log(path))
        reason = "the file is shorter than its header says"
    except Exception as error:  # what is damaged decides what rosbags raises
        reason = _reason(error)
    walk = _WALKS[kind]
    counts: Counter[tuple[str, str]] = Counter()
    # the counts up to where the file breaks off are what there is; `messages` says why
    with contextlib.suppress(Exception):
        counts.update((message.topic, message.type) for message in walk(path))
    return BagFile(path, [Topic(name, kind, count) for (name, kind), count in counts.items()], f"{path.name} read without its index: {reason}", walk)


def _unmerged_log(path: Path) -> str:
    """SQLite's log beside the file, left by a recorder that crashed: what it holds is not read."""
    log = path.with_name(path.name + "-wal")
    if not log.is_file() or log.stat().st_size == 0:
        return ""
    return f"{log.name} holds messages that {path.name} does not; merge them with: sqlite3 {path} 'PRAGMA wal_checkpoint(TRUNCATE)'"


def _indexed_topics(path: Path) -> list[Topic]:
    with _reader(path) as reader:
        return [Topic(name, info.msgtype or info.connections[0].msgtype, info.msgcount) for name, info in reader.topics.items()]


def _reader(path: Path) -> Any:
    return rosbag1.Reader(path) if path.is_file() and _kind(path) == "bag" else rosbag2.Reader(path)


def _kind(path: Path) -> str | None:
    with path.open("rb") as file:
        start = file.read(16)
    magics = {b"#ROSBAG V2": "bag", b"\x89MCAP": "mcap", b"SQLite format 3": "db3"}
    return next((kind for magic, kind in magics.items() if start.startswith(magic)), None)


def _reason(error: BaseException) -> str:
    text = str(error.args[0]) if error.args else type(error).__name__
    if isinstance(error, struct.error | EOFError | EndOfFile) or text.startswith(("Got only", "Header could not be read", "Could not read")):
        return "the file ends in the middle of a record"
    return (text.strip().splitlines() or [type(error).__name__])[0][:160]


_WALKS: dict[str, Walk] = {"bag": walk_ros1, "mcap": walk_mcap, "db3": walk_db3}
