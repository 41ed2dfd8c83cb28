"""Reading rosbag 2.0 (ROS 1): http://wiki.ros.org/Bags/Format/2.0. Its index is not needed."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from struct import Struct
from typing import BinaryIO

from service.datasets.formats.bags.container import Channel, Data, ScannedBag, Unpacking, damaged, type_name

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, CHUNK, CONNECTION = 0x02, 0x03, 0x05, 0x07
LONGEST_HEADER = 1024 * 1024
_U32, _TIME = Struct("<I"), Struct("<II")


class Rosbag1(ScannedBag):
    """A bag of ROS 1; raise InvalidDataError where it is none."""

    def scan(self) -> Iterator[tuple[Channel, int, Data]]:
        """Channel, time of reception in ns and data of every message, up to where the file was cut off."""
        channels: dict[int, Channel] = {}
        unpacking = self.unpacking()
        with self.path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
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
                if length > min(LONGEST_HEADER, end - file.tell()):
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
