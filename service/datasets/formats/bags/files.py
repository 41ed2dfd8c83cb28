"""Reading bag files: rosbag 2.0 of ROS 1, MCAP, and the sqlite3 files of rosbag2.

Specifications: http://wiki.ros.org/Bags/Format/2.0 and https://mcap.dev/spec. The readers need neither an index nor a
metadata.yaml, so they also read incomplete recordings.
"""

from __future__ import annotations

import os
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from contextlib import closing
from struct import Struct
from typing import BinaryIO

from service.datasets.formats.bags.container import (
    MAX_PART_BYTES,
    Bag,
    Channel,
    Data,
    ScannedBag,
    Unpacker,
    damaged,
    type_name,
)

_CUT_OFF = "the file ends within a record at byte {}; its recording is read up to there"
ROSBAG1_MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, CHUNK, CONNECTION = 0x02, 0x03, 0x05, 0x07
_U32, _TIME = Struct("<I"), Struct("<II")


class Rosbag1(ScannedBag):
    """A ROS 1 bag; raise InvalidDataError if the file is not one."""

    def scan(self) -> Iterator[tuple[Channel, int, Data]]:
        """Yield the channel, reception time in ns and data of every message, up to where the file was cut off."""
        channels: dict[int, Channel] = {}
        unpacker = self.unpacker()
        with self.path.open("rb") as file:
            if file.read(len(ROSBAG1_MAGIC)) != ROSBAG1_MAGIC:
                raise damaged("not a rosbag of version 2.0")
            for offset, header, data in self._records(file, unpacker):
                try:
                    if header["op"] == bytes((CHUNK,)):
                        yield from _chunk(header, data, channels, unpacker)
                    else:
                        yield from _record(header, data, channels)
                except KeyError as error:
                    raise damaged(f"a record has no field {error}", offset) from None
                except (struct.error, ValueError, OSError) as error:
                    raise damaged(str(error), offset) from None

    def _records(self, file: BinaryIO, unpacker: Unpacker) -> Iterator[tuple[int, dict[str, bytes], memoryview]]:
        end = os.fstat(file.fileno()).st_size
        while (offset := file.tell()) < end:
            try:
                (length,) = _U32.unpack(file.read(4))
                if length > min(1024 * 1024, end - file.tell()):
                    raise EOFError
                header = _header(memoryview(file.read(length)))
                (size,) = _U32.unpack(file.read(4))
                if size > end - file.tell():
                    raise EOFError
            except (EOFError, struct.error):
                return self.add_fact(_CUT_OFF.format(offset))
            except ValueError as error:
                raise damaged(str(error), offset) from None
            kind = header.get("op", b"")
            if kind == bytes((BAG_HEADER,)):
                if header.get("encryptor"):
                    raise damaged("it is encrypted")
                if not any(header.get("index_pos", b"")):
                    self.add_fact("the bag has no index: its recording was cut off and is read as far as possible")
            if kind in (bytes((MESSAGE,)), bytes((CHUNK,)), bytes((CONNECTION,))):
                if kind != bytes((CHUNK,)) or size > unpacker.max_part:
                    unpacker.count(size)
                yield offset, header, memoryview(file.read(size))
            else:
                file.seek(size, os.SEEK_CUR)
        return None


def _chunk(
    header: dict[str, bytes], data: memoryview, channels: dict[int, Channel], unpacker: Unpacker
) -> Iterator[tuple[Channel, int, Data]]:
    (size,) = _U32.unpack(header["size"])
    unpacked = memoryview(unpacker.unpack(data, header["compression"].decode(), size))
    at = 0
    while at < size:
        inner, at = _sized(unpacked, at)
        content, at = _sized(unpacked, at)
        yield from _record(_header(inner), content, channels)


def _record(
    header: dict[str, bytes], data: memoryview, channels: dict[int, Channel]
) -> Iterator[tuple[Channel, int, Data]]:
    kind = header["op"][0]
    if kind == MESSAGE:
        (number,) = _U32.unpack(header["conn"])
        if number not in channels:
            raise ValueError(f"a message has connection {number}, which is not declared before it")
        seconds, nanoseconds = _TIME.unpack(header["time"])
        yield channels[number], seconds * 1_000_000_000 + nanoseconds, data
    elif kind == CONNECTION:
        (number,) = _U32.unpack(header["conn"])
        declared = _header(data)
        name, definition = type_name(declared["type"].decode()), declared["message_definition"].decode(errors="replace")
        channels[number] = Channel(header["topic"].decode(), name, "ros1", definition)


def _sized(content: memoryview, at: int) -> tuple[memoryview, int]:
    (length,) = _U32.unpack_from(content, at)
    at += 4
    if length > len(content) - at:
        raise ValueError(f"a record in a chunk declares {length} bytes, but {len(content) - at} remain")
    return content[at : at + length], at + length


def _header(content: memoryview) -> dict[str, bytes]:
    fields: dict[str, bytes] = {}
    at = 0
    while at < len(content):
        field, at = _sized(content, at)
        name, separator, value = bytes(field).partition(b"=")
        if not separator:
            raise ValueError("a header field has no value")
        fields[name.decode("ascii")] = value
    return fields


MCAP_MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MCAP_MESSAGE, MCAP_CHUNK, DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
_HEAD, _MESSAGE_HEAD, _CHUNK_HEAD = Struct("<BQ"), Struct("<HIQQ"), Struct("<QQQI")
_U16, _U64 = Struct("<H"), Struct("<Q")


class Mcap(ScannedBag):
    """An MCAP file; raise InvalidDataError if the file is not one."""

    def scan(self) -> Iterator[tuple[Channel, int, Data]]:
        """Yield the channel, reception time in ns and data of every message, up to where the file was cut off."""
        schemas: dict[int, tuple[str, str | None]] = {}
        channels: dict[int, Channel] = {}
        unpacker = self.unpacker()
        with self.path.open("rb") as file:
            if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
                raise damaged("not an MCAP file")
            for kind, offset, content in self._records(file, unpacker):
                try:
                    yield from _mcap_record(kind, content, schemas, channels, unpacker)
                except (struct.error, ValueError, OSError, KeyError) as error:
                    raise damaged(str(error), offset) from None

    def _records(self, file: BinaryIO, unpacker: Unpacker) -> Iterator[tuple[int, int, memoryview]]:
        end = os.fstat(file.fileno()).st_size
        while True:
            offset = file.tell()
            head = file.read(_HEAD.size)
            if len(head) < _HEAD.size:
                return self.add_fact("the file has no end: its recording was cut off and is read as far as possible")
            kind, length = _HEAD.unpack(head)
            if kind in (FOOTER, DATA_END):
                return None
            if length > end - file.tell():
                return self.add_fact(_CUT_OFF.format(offset))
            if kind in (SCHEMA, CHANNEL, MCAP_MESSAGE, MCAP_CHUNK):
                if kind != MCAP_CHUNK or length > unpacker.max_part:  # a chunk is counted when it is unpacked
                    unpacker.count(length)
                yield kind, offset, memoryview(file.read(length))
            else:
                file.seek(length, os.SEEK_CUR)


def _mcap_record(
    kind: int,
    content: memoryview,
    schemas: dict[int, tuple[str, str | None]],
    channels: dict[int, Channel],
    unpacker: Unpacker,
) -> Iterator[tuple[Channel, int, Data]]:
    if kind == MCAP_MESSAGE:
        number, _, time, _ = _MESSAGE_HEAD.unpack_from(content)
        if number not in channels:
            raise ValueError(f"a message has channel {number}, which is not declared before it")
        if time >= 1 << 63:
            raise ValueError(f"a message has the time {time} ns, which is too large")
        yield channels[number], time, content[_MESSAGE_HEAD.size :]
    elif kind == SCHEMA:
        (number,) = _U16.unpack_from(content)
        name, at = _mcap_text(content, 2)
        encoding, at = _mcap_text(content, at)
        definition, _ = _mcap_text(content, at)
        schemas[number] = type_name(name), definition if encoding in ("ros2msg", "ros1msg") else None
    elif kind == CHANNEL:
        (number,), (schema,) = _U16.unpack_from(content), _U16.unpack_from(content, 2)
        topic, at = _mcap_text(content, 4)
        encoding, _ = _mcap_text(content, at)
        type_and_text = schemas.get(schema, ("", None))
        channels[number] = Channel(topic, type_and_text[0], encoding, type_and_text[1])
    elif kind == MCAP_CHUNK:
        _, _, size, checksum = _CHUNK_HEAD.unpack_from(content)
        compression, at = _mcap_text(content, _CHUNK_HEAD.size)
        (packed,) = _U64.unpack_from(content, at)
        if packed > len(content) - at - 8:
            raise ValueError(f"a chunk declares {packed} bytes, but {len(content) - at - 8} remain")
        unpacked = memoryview(unpacker.unpack(content[at + 8 : at + 8 + packed], compression, size))
        if checksum and zlib.crc32(unpacked) != checksum:
            raise ValueError("the checksum of a chunk does not match")
        at = 0
        while at < size:
            inner, length = _HEAD.unpack_from(unpacked, at)
            at += _HEAD.size
            if length > size - at or inner == MCAP_CHUNK:
                raise ValueError(f"a record in a chunk declares {length} bytes, but {size - at} remain")
            if inner in (SCHEMA, CHANNEL, MCAP_MESSAGE):
                yield from _mcap_record(inner, unpacked[at : at + length], schemas, channels, unpacker)
            at += length


def _mcap_text(content: memoryview, at: int) -> tuple[str, int]:
    (length,) = _U32.unpack_from(content, at)
    if length > len(content) - at - 4:
        raise ValueError(f"a text declares {length} bytes, but {len(content) - at - 4} remain")
    return str(content[at + 4 : at + 4 + length], "utf-8"), at + 4 + length


SQLITE_MAGIC = b"SQLite format 3\x00"
SQLITE_ERRORS = (sqlite3.Error, UnicodeDecodeError)
"""Errors of sqlite3 for a damaged file; its messages may quote bytes that are not text."""


class SqliteBag(Bag):
    """A sqlite3 file of a rosbag2; raise InvalidDataError if the file is not one."""

    def channels(self) -> dict[Channel, int]:
        """Return the number of messages of every channel that has any."""
        try:
            with closing(self._connect()) as database:
                definitions = _definitions(database)
                rows = database.execute(
                    "SELECT t.name, t.type, t.serialization_format, count(*) "
                    "FROM messages m JOIN topics t ON t.id = m.topic_id GROUP BY t.id ORDER BY t.id"
                ).fetchall()
        except SQLITE_ERRORS as error:
            raise damaged(str(error)) from None
        counts: dict[Channel, int] = {}
        for topic, name, encoding, count in rows:
            channel = Channel(str(topic), type_name(str(name)), str(encoding), definitions.get(type_name(str(name))))
            counts[channel] = counts.get(channel, 0) + count
        return counts

    def messages(self, channel: Channel) -> Iterator[tuple[int, bytes]]:
        """Yield the reception time in ns and the data of every message of a channel's topic and type."""
        unpacker = self.unpacker()
        try:
            with closing(self._connect()) as database:
                rows = database.execute(
                    "SELECT m.timestamp, m.data FROM messages m JOIN topics t ON t.id = m.topic_id "
                    "WHERE t.name = ? AND replace(t.type, '/msg/', '/') = ? ORDER BY m.timestamp, m.id",
                    (channel.topic, channel.type),
                )
                for time, data in rows:
                    if not isinstance(time, int) or not isinstance(data, bytes):
                        raise damaged("a message has no time or no data")
                    yield time, unpacker.message(data)
        except SQLITE_ERRORS as error:
            raise damaged(str(error)) from None

    def _connect(self) -> sqlite3.Connection:
        # immutable=1: sqlite3 looks for no journal and locks nothing
        database = sqlite3.connect(f"{self.path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
        try:
            database.text_factory = _text
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_PART_BYTES)
            database.execute("PRAGMA trusted_schema = OFF")
            database.execute("PRAGMA cell_size_check = ON")
            for table in ("messages", "topics"):
                if not _has_table(database, table):
                    raise damaged(f"the database has no table {table!r}")
        except BaseException:
            database.close()
            raise
        return database


def _has_table(database: sqlite3.Connection, name: str) -> bool:
    """Return whether there is a plain table; a view or a virtual table could run SQL from the file."""
    query = "SELECT 1 FROM sqlite_master WHERE name = ? AND type = 'table' AND sql LIKE 'CREATE TABLE%'"
    return database.execute(query, (name,)).fetchone() is not None


def _text(raw: bytes) -> str:
    return raw.decode(errors="replace")


def _definitions(database: sqlite3.Connection) -> dict[str, str]:
    """Return the definitions by type; bags hold them since ROS 2 Iron."""
    if not _has_table(database, "message_definitions"):
        return {}
    rows = database.execute(
        "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = 'ros2msg'"
    )
    return {type_name(str(name)): str(text) for name, text in rows}
