"""The files that bags are: rosbag 2.0 of ROS 1 (http://wiki.ros.org/Bags/Format/2.0), MCAP (https://mcap.dev/spec), and
the sqlite3 of rosbag2. Neither an index nor a metadata.yaml is needed, so that a recording which was cut off is read
too."""

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
    Unpacking,
    damaged,
    type_name,
)

ROSBAG1_MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, CHUNK, CONNECTION = 0x02, 0x03, 0x05, 0x07
_U32, _TIME = Struct("<I"), Struct("<II")


class Rosbag1(ScannedBag):
    """A bag of ROS 1; raise InvalidDataError where it is none."""

    def scan(self) -> Iterator[tuple[Channel, int, Data]]:
        """Channel, time of reception in ns and data of every message, up to where the file was cut off."""
        channels: dict[int, Channel] = {}
        unpacking = self.unpacking()
        with self.path.open("rb") as file:
            if file.read(len(ROSBAG1_MAGIC)) != ROSBAG1_MAGIC:
                raise damaged("no rosbag of version 2.0")
            for offset, header, data in self._records(file, unpacking):
                try:
                    if header["op"] == bytes((CHUNK,)):
                        yield from _chunk(header, data, channels, unpacking)
                    else:
                        yield from _record(header, data, channels)
                except KeyError as error:
                    raise damaged(f"a record without {error}", offset) from None
                except (struct.error, ValueError, OSError) as error:
                    raise damaged(str(error), offset) from None

    def _records(self, file: BinaryIO, unpacking: Unpacking) -> Iterator[tuple[int, dict[str, bytes], memoryview]]:
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
                return self.tell(f"the file ends within a record, at byte {offset}: its recording is read up to there")
            except ValueError as error:
                raise damaged(str(error), offset) from None
            kind = header.get("op", b"")
            if kind == bytes((BAG_HEADER,)):
                if header.get("encryptor"):
                    raise damaged("encrypted")
                if not any(header.get("index_pos", b"")):
                    self.tell("the bag has no index: its recording was cut off, and is read as far as it goes")
            if kind in (bytes((MESSAGE,)), bytes((CHUNK,)), bytes((CONNECTION,))):
                if kind != bytes((CHUNK,)) or size > unpacking.most_at_once:
                    unpacking.take(size)
                yield offset, header, memoryview(file.read(size))
            else:
                file.seek(size, os.SEEK_CUR)
        return None


def _chunk(
    header: dict[str, bytes], data: memoryview, channels: dict[int, Channel], unpacking: Unpacking
) -> Iterator[tuple[Channel, int, Data]]:
    (size,) = _U32.unpack(header["size"])
    unpacked = memoryview(unpacking.unpack(data, header["compression"].decode(), size))
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
            raise ValueError(f"a message of connection {number}, which is not declared before it")
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
        raise ValueError(f"a record of {length} bytes in a chunk, {len(content) - at} there")
    return content[at : at + length], at + length


def _header(content: memoryview) -> dict[str, bytes]:
    fields: dict[str, bytes] = {}
    at = 0
    while at < len(content):
        field, at = _sized(content, at)
        name, separator, value = bytes(field).partition(b"=")
        if not separator:
            raise ValueError("a header's field without a value")
        fields[name.decode("ascii")] = value
    return fields


MCAP_MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MCAP_MESSAGE, MCAP_CHUNK, DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
_HEAD, _MESSAGE_HEAD, _CHUNK_HEAD = Struct("<BQ"), Struct("<HIQQ"), Struct("<QQQI")
_U16, _U64 = Struct("<H"), Struct("<Q")


class Mcap(ScannedBag):
    """An MCAP file; raise InvalidDataError where it is none."""

    def scan(self) -> Iterator[tuple[Channel, int, Data]]:
        """Channel, time of reception in ns and data of every message, up to where the file was cut off."""
        schemas: dict[int, tuple[str, str | None]] = {}
        channels: dict[int, Channel] = {}
        unpacking = self.unpacking()
        with self.path.open("rb") as file:
            if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
                raise damaged("no MCAP file")
            for kind, offset, content in self._records(file, unpacking):
                try:
                    yield from _mcap_record(kind, content, schemas, channels, unpacking)
                except (struct.error, ValueError, OSError, KeyError) as error:
                    raise damaged(str(error), offset) from None

    def _records(self, file: BinaryIO, unpacking: Unpacking) -> Iterator[tuple[int, int, memoryview]]:
        end = os.fstat(file.fileno()).st_size
        while True:
            offset = file.tell()
            head = file.read(_HEAD.size)
            if len(head) < _HEAD.size:
                return self.tell("the file has no end: its recording was cut off, and is read as far as it goes")
            kind, length = _HEAD.unpack(head)
            if kind in (FOOTER, DATA_END):
                return None
            if length > end - file.tell():
                return self.tell(f"the file ends within a record, at byte {offset}: its recording is read up to there")
            if kind in (SCHEMA, CHANNEL, MCAP_MESSAGE, MCAP_CHUNK):
                if kind != MCAP_CHUNK or length > unpacking.most_at_once:  # a chunk counts once unpacked
                    unpacking.take(length)
                yield kind, offset, memoryview(file.read(length))
            else:
                file.seek(length, os.SEEK_CUR)


def _mcap_record(
    kind: int,
    content: memoryview,
    schemas: dict[int, tuple[str, str | None]],
    channels: dict[int, Channel],
    unpacking: Unpacking,
) -> Iterator[tuple[Channel, int, Data]]:
    if kind == MCAP_MESSAGE:
        number, _, time, _ = _MESSAGE_HEAD.unpack_from(content)
        if number not in channels:
            raise ValueError(f"a message of channel {number}, which is not declared before it")
        if time >= 1 << 63:
            raise ValueError(f"a message of {time} ns after 1970")
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
            raise ValueError(f"a chunk of {packed} bytes declared, {len(content) - at - 8} there")
        unpacked = memoryview(unpacking.unpack(content[at + 8 : at + 8 + packed], compression, size))
        if checksum and zlib.crc32(unpacked) != checksum:
            raise ValueError("a chunk's checksum does not agree")
        at = 0
        while at < size:
            inner, length = _HEAD.unpack_from(unpacked, at)
            at += _HEAD.size
            if length > size - at or inner == MCAP_CHUNK:
                raise ValueError(f"a record of {length} bytes in a chunk, {size - at} there")
            if inner in (SCHEMA, CHANNEL, MCAP_MESSAGE):
                yield from _mcap_record(inner, unpacked[at : at + length], schemas, channels, unpacking)
            at += length


def _mcap_text(content: memoryview, at: int) -> tuple[str, int]:
    (length,) = _U32.unpack_from(content, at)
    if length > len(content) - at - 4:
        raise ValueError(f"a text of {length} bytes, {len(content) - at - 4} there")
    return str(content[at + 4 : at + 4 + length], "utf-8"), at + 4 + length


SQLITE_MAGIC = b"SQLite format 3\x00"


SQLITE_ERRORS = (sqlite3.Error, UnicodeDecodeError)
"""What sqlite3 raises of a damaged file: its own messages may quote bytes that are no text."""


class SqliteBag(Bag):
    """One sqlite3 file of a rosbag2; raise InvalidDataError where it is none."""

    def channels(self) -> dict[Channel, int]:
        """Number of messages of every channel that has any."""
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
        """Time of reception in ns and data of every message of a channel's topic and type."""
        unpacking = self.unpacking()
        try:
            with closing(self._connect()) as database:
                rows = database.execute(
                    "SELECT m.timestamp, m.data FROM messages m JOIN topics t ON t.id = m.topic_id "
                    "WHERE t.name = ? AND replace(t.type, '/msg/', '/') = ? ORDER BY m.timestamp, m.id",
                    (channel.topic, channel.type),
                )
                for time, data in rows:
                    if not isinstance(time, int) or not isinstance(data, bytes):
                        raise damaged("a message without a time or without data")
                    yield time, unpacking.message(data)
        except SQLITE_ERRORS as error:
            raise damaged(str(error)) from None

    def _connect(self) -> sqlite3.Connection:
        # immutable: no journal beside the file is looked for, and nothing is locked
        database = sqlite3.connect(f"{self.path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
        try:
            database.text_factory = _text
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_PART_BYTES)
            database.execute("PRAGMA trusted_schema = OFF")
            database.execute("PRAGMA cell_size_check = ON")
            for table in ("messages", "topics"):
                if not _has_table(database, table):
                    raise damaged(f"a database without a table {table!r}")
        except BaseException:
            database.close()
            raise
        return database


def _has_table(database: sqlite3.Connection, name: str) -> bool:
    """Whether there is a plain table: a view or a virtual one would run what the file says."""
    query = "SELECT 1 FROM sqlite_master WHERE name = ? AND type = 'table' AND sql LIKE 'CREATE TABLE%'"
    return database.execute(query, (name,)).fetchone() is not None


def _text(raw: bytes) -> str:
    return raw.decode(errors="replace")


def _definitions(database: sqlite3.Connection) -> dict[str, str]:
    """Definitions of types, as bags hold them since ROS 2 Iron."""
    if not _has_table(database, "message_definitions"):
        return {}
    rows = database.execute(
        "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = 'ros2msg'"
    )
    return {type_name(str(name)): str(text) for name, text in rows}
