"""Reading MCAP: https://mcap.dev/spec. The index at the end is not needed, so a cut-off recording is read too."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from struct import Struct
from typing import BinaryIO

from service.datasets.formats.bags.container import Channel, Data, ScannedBag, Unpacking, damaged, type_name

MAGIC = b"\x89MCAP0\r\n"
LATEST = 1 << 63
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
_RECORD, _MESSAGE, _CHUNK = Struct("<BQ"), Struct("<HIQQ"), Struct("<QQQI")
_U16, _U32, _U64 = Struct("<H"), Struct("<I"), Struct("<Q")
_TEXT_DEFINITIONS = ("ros2msg", "ros1msg")


class Mcap(ScannedBag):
    """An MCAP file; raise InvalidDataError where it is none."""

    def scan(self) -> Iterator[tuple[Channel, int, Data]]:
        """Channel, time of reception in ns and data of every message, up to where the file was cut off."""
        schemas: dict[int, tuple[str, str | None]] = {}
        channels: dict[int, Channel] = {}
        unpacking = self.unpacking()
        with self.path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise damaged("no MCAP file")
            for kind, offset, content in self._records(file, unpacking):
                try:
                    yield from _read(kind, content, schemas, channels, unpacking)
                except (struct.error, ValueError, OSError, KeyError) as error:
                    raise damaged(str(error), offset) from None

    def _records(self, file: BinaryIO, unpacking: Unpacking) -> Iterator[tuple[int, int, memoryview]]:
        end = os.fstat(file.fileno()).st_size
        while True:
            offset = file.tell()
            head = file.read(_RECORD.size)
            if len(head) < _RECORD.size:
                return self.tell("the file has no end: its recording was cut off, and is read as far as it goes")
            kind, length = _RECORD.unpack(head)
            if kind in (FOOTER, DATA_END):
                return None
            if length > end - file.tell():
                return self.tell(f"the file ends within a record, at byte {offset}: its recording is read up to there")
            if kind in (SCHEMA, CHANNEL, MESSAGE, CHUNK):
                if kind != CHUNK or length > unpacking.most_at_once:  # a chunk counts once unpacked
                    unpacking.take(length)
                yield kind, offset, memoryview(file.read(length))
            else:
                file.seek(length, os.SEEK_CUR)


def _read(
    kind: int,
    content: memoryview,
    schemas: dict[int, tuple[str, str | None]],
    channels: dict[int, Channel],
    unpacking: Unpacking,
) -> Iterator[tuple[Channel, int, Data]]:
    if kind == MESSAGE:
        number, _, time, _ = _MESSAGE.unpack_from(content)
        if number not in channels:
            raise ValueError(f"a message of channel {number}, which is not declared before it")
        if time >= LATEST:
            raise ValueError(f"a message of {time} ns after 1970")
        yield channels[number], time, content[_MESSAGE.size :]
    elif kind == SCHEMA:
        (number,) = _U16.unpack_from(content)
        name, at = _text(content, 2)
        encoding, at = _text(content, at)
        definition, _ = _text(content, at)
        schemas[number] = type_name(name), definition if encoding in _TEXT_DEFINITIONS else None
    elif kind == CHANNEL:
        (number,), (schema,) = _U16.unpack_from(content), _U16.unpack_from(content, 2)
        topic, at = _text(content, 4)
        encoding, _ = _text(content, at)
        type_and_text = schemas.get(schema, ("", None))
        channels[number] = Channel(topic, type_and_text[0], encoding, type_and_text[1])
    elif kind == CHUNK:
        _, _, size, checksum = _CHUNK.unpack_from(content)
        compression, at = _text(content, _CHUNK.size)
        (packed,) = _U64.unpack_from(content, at)
        if packed > len(content) - at - 8:
            raise ValueError(f"a chunk of {packed} bytes declared, {len(content) - at - 8} there")
        unpacked = memoryview(unpacking.unpack(content[at + 8 : at + 8 + packed], compression, size))
        if checksum and zlib.crc32(unpacked) != checksum:
            raise ValueError("a chunk's checksum does not agree")
        at = 0
        while at < size:
            inner, length = _RECORD.unpack_from(unpacked, at)
            at += _RECORD.size
            if length > size - at or inner == CHUNK:
                raise ValueError(f"a record of {length} bytes in a chunk, {size - at} there")
            if inner in (SCHEMA, CHANNEL, MESSAGE):
                yield from _read(inner, unpacked[at : at + length], schemas, channels, unpacking)
            at += length


def _text(content: memoryview, at: int) -> tuple[str, int]:
    (length,) = _U32.unpack_from(content, at)
    if length > len(content) - at - 4:
        raise ValueError(f"a text of {length} bytes, {len(content) - at - 4} there")
    return str(content[at + 4 : at + 4 + length], "utf-8"), at + 4 + length
