"""Bag files without a sound index, walked record by record until they break off.

Formats: ROS bag 2.0, MCAP, and the SQLite schema of rosbag2_storage_sqlite3.
"""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags import rosbag1
from rosbags.rosbag1.reader import Header, RecordType, read_bytes, read_uint32
from rosbags.typesys import Stores, get_typestore

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
_ZSTD = b"\x28\xb5\x2f\xfd"


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


def walk_ros1(path: Path) -> Iterator[RawMessage]:
    """Messages of a ROS 1 bag in the file's order. Raises ReaderError where the file breaks off."""
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


def walk_mcap(path: Path) -> Iterator[RawMessage]:
    """Messages of an mcap file in the file's order, without those of other encodings. Raises what the reader raises where the file breaks off, and McapError if
    all are encoded otherwise."""
    understood, other = False, ""
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
                    other = channel.message_encoding
                    continue
                understood = True
                yield RawMessage(channel.topic, _full_type(kind), record.data, channel.message_encoding == "ros1")
    if other and not understood:
        raise McapError(f"messages are encoded as {other!r}; understood are cdr (ROS 2) and ros1")


def walk_db3(path: Path) -> Iterator[RawMessage]:
    """Messages of an SQLite bag in the order of recording. Raises sqlite3.Error where the file breaks off."""
    with tempfile.TemporaryDirectory() as folder:
        if db3_is_short(path):
            path = _openable_db3(path, Path(folder) / path.name)
        with contextlib.closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
            topics = {row[0]: (row[1], row[2]) for row in database.execute("SELECT id, name, type FROM topics")}
            for topic_id, data in database.execute("SELECT topic_id, data FROM messages NOT INDEXED ORDER BY rowid"):
                yield RawMessage(*topics[topic_id], data, False)


def db3_is_short(path: Path) -> bool:
    """Whether an SQLite file is shorter than its header states."""
    size, pages = _db3_pages(path)
    return path.stat().st_size < size * pages


def _openable_db3(path: Path, copy: Path) -> Path:
    """A copy whose header states the whole pages that are there: SQLite opens no file that is shorter than its header says."""
    size, _ = _db3_pages(path)
    pages = path.stat().st_size // size
    shutil.copyfile(path, copy)
    with copy.open("r+b") as file:
        file.truncate(pages * size)
        file.seek(28)
        file.write(pages.to_bytes(4, "big"))
    return copy


def _db3_pages(path: Path) -> tuple[int, int]:
    """Page size (bytes) and number of pages that the file's header states."""
    with path.open("rb") as file:
        start = file.read(100)
    size = int.from_bytes(start[16:18], "big")
    return 65536 if size == 1 else size, int.from_bytes(start[28:32], "big")


def _full_type(name: str) -> str:
    return name if name.count("/") != 1 else name.replace("/", "/msg/")
