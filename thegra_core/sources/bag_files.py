"""Bag files as streams of serialised messages: through their index where it is sound, else by walking over what is there.

rosbags reads ROS 1 bags, rosbag2 folders, mcap and db3. Files that it refuses (never closed, cut short, index lost) are walked record by record.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags import rosbag1, rosbag2
from rosbags.rosbag1.reader import Header, RecordType, read_bytes, read_uint32
from rosbags.typesys import Stores, get_typestore

from thegra_core.errors import InputError

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
_ZSTD = b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag file; count None: unknown without reading."""

    name: str
    type: str
    count: int | None


@dataclass(frozen=True, slots=True)
class RawMessage:
    """One message as stored; `decode()` gives the object with the message's fields."""

    topic: str
    type: str
    data: bytes
    is_ros1: bool

    def decode(self) -> Any:
        """The message. Raises whatever the damage in the data makes the deserialiser raise."""
        if self.is_ros1:
            return ROS1.deserialize_ros1(self.data, self.type)
        data = zstandard.ZstdDecompressor().decompressobj().decompress(self.data) if self.data[:4] == _ZSTD else self.data
        return ROS2.deserialize_cdr(data, self.type)


Walk = Callable[[Path], Iterator[RawMessage]]


@dataclass
class BagFile:
    """One bag file, or one rosbag2 folder with sound metadata; `damage` says why it cannot be read through its index."""

    path: Path
    topics: list[Topic]
    damage: str = ""
    walk: Walk | None = None
    problems: Counter[str] = field(default_factory=Counter)

    def messages(self, topic: str) -> Iterator[RawMessage]:
        """The messages of a topic in the file's order; where the file breaks off, the reason is counted in `problems`."""
        self.problems.clear()
        if self.damage:
            self.problems[self.damage] += 1
        stream = self._indexed(topic) if self.walk is None else (m for m in self.walk(self.path) if m.topic == topic)
        try:
            yield from stream
        except Exception as error:  # what is damaged decides what the libraries raise
            self.problems[f"{self.path.name} breaks off: {_reason(error)}"] += 1

    def _indexed(self, topic: str) -> Iterator[RawMessage]:
        with _reader(self.path) as reader:
            connections = [c for c in reader.connections if c.topic == topic]
            if connections:
                for connection, _, data in reader.messages(connections):
                    yield RawMessage(topic, connection.msgtype, bytes(data), isinstance(reader, rosbag1.Reader))


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
    from thegra_core.sources.folder import natural_key

    bags = [_open_file(file) for file in sorted(files, key=lambda f: natural_key(f.name))]
    if _kind(files[0]) != "bag":
        bags[0].damage = bags[0].damage or damage
    return bags


def _open_file(path: Path) -> BagFile:
    kind = _kind(path)
    if kind is None:
        raise InputError(f"{path} is {'empty' if path.stat().st_size == 0 else 'no bag: it starts like none'}; give a ROS 1 .bag, a rosbag2 folder, .mcap or .db3")
    try:
        return BagFile(path, _indexed_topics(path))
    except Exception as error:  # what is damaged decides what rosbags raises
        damage = f"{path.name} read without its index: {_reason(error)}"
    walk = _WALKS[kind]
    counts: Counter[tuple[str, str]] = Counter()
    try:
        for message in walk(path):
            counts[message.topic, message.type] += 1
    except Exception as error:  # the counts so far are what there is
        damage += f"; breaks off: {_reason(error)}"
    return BagFile(path, [Topic(name, kind, count) for (name, kind), count in counts.items()], damage, walk)


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
    return (text.strip().splitlines() or [type(error).__name__])[0][:160]


def _walk_ros1(path: Path) -> Iterator[RawMessage]:
    reader = rosbag1.Reader(path)
    types: dict[int, tuple[str, str]] = {}
    with path.open("rb") as file:
        file.readline()
        yield from _ros1_records(reader, file, types)


def _ros1_records(reader: rosbag1.Reader, file: BinaryIO, types: dict[int, tuple[str, str]]) -> Iterator[RawMessage]:
    while True:
        start = file.tell()
        if not file.read(1):
            return
        file.seek(start)
        header = Header.read(file)
        operation = header.get_uint8("op")
        if operation == RecordType.CONNECTION:
            file.seek(start)
            reader.bio = file
            connection = reader.read_connection()
            types[connection.id] = (connection.topic, connection.msgtype)
        elif operation == RecordType.MSGDATA:
            topic, kind = types[header.get_uint32("conn")]
            yield RawMessage(topic, kind, read_bytes(file, read_uint32(file)), True)
        elif operation == RecordType.CHUNK:
            file.seek(start)
            reader.bio = file
            chunk = reader.read_chunk()
            file.seek(chunk.datapos)
            data = file.read(chunk.datasize)
            uncompressed = header.get_string("compression") == "none"
            yield from _ros1_records(reader, BytesIO(data if uncompressed else chunk.decompressor(data)), types)
        else:
            read_bytes(file, read_uint32(file))


def _walk_mcap(path: Path) -> Iterator[RawMessage]:
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with path.open("rb") as file:
        for record in StreamReader(file).records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                kind = schemas[channel.schema_id].name if channel.schema_id in schemas else ""
                if channel.message_encoding not in ("cdr", "ros1"):
                    raise McapError(f"messages are encoded as {channel.message_encoding!r}; understood are cdr (ROS 2) and ros1")
                yield RawMessage(channel.topic, _full_type(kind), record.data, channel.message_encoding == "ros1")


def _walk_db3(path: Path) -> Iterator[RawMessage]:
    database = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
    try:
        topics = {row[0]: (row[1], row[2]) for row in database.execute("SELECT id, name, type FROM topics")}
        for topic_id, data in database.execute("SELECT topic_id, data FROM messages NOT INDEXED ORDER BY rowid"):
            yield RawMessage(*topics[topic_id], data, False)
    finally:
        database.close()


def _full_type(name: str) -> str:
    return name if name.count("/") != 1 else name.replace("/", "/msg/")


_WALKS: dict[str, Walk] = {"bag": _walk_ros1, "mcap": _walk_mcap, "db3": _walk_db3}
