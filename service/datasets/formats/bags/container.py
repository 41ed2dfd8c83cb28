"""The interface of all bag readers: channels, and their messages in the order of their recording.

The service has its own readers, for three reasons. An incomplete recording is read up to where it was cut off. Nothing
is unpacked beyond a limit. No code is generated from message definitions, which come with the upload.
"""

from __future__ import annotations

import bz2
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa

from service.datasets.formats.table import unreadable
from service.foundation.errors import InvalidDataError, TooLargeError
from service.foundation.settings import Settings

Data = bytes | memoryview
MAX_PART_BYTES = 64 * 1024 * 1024
"""Max size of a chunk or message of a bag after unpacking."""


class Channel(NamedTuple):
    """One topic of one type."""

    topic: str
    type: str
    """`package/Name`."""
    encoding: str
    """Of its messages: `cdr`, `ros1`, or one that cannot be read."""
    definition: str | None
    """Definition of the type as text; None if the bag does not hold it."""


class Bag(ABC):
    """A bag in one file. facts: sentences for the report, complete after the bag is read."""

    def __init__(self, path: Path, settings: Settings) -> None:
        self.path, self.settings = path, settings
        self.facts: list[str] = []

    @abstractmethod
    def channels(self) -> dict[Channel, int]:
        """Return the number of messages of every channel that has any; raise InvalidDataError."""

    @abstractmethod
    def messages(self, channel: Channel) -> Iterator[tuple[int, bytes]]:
        """Yield the reception time in ns and the data of every message of a channel's topic and type."""

    def unpacker(self) -> Unpacker:
        """Return an unpacker with the limits of one pass through the bag."""
        return Unpacker(MAX_PART_BYTES, self.settings.max_unpacked_bytes)


class ScannedBag(Bag):
    """A bag that is read from front to back by `scan`."""

    @abstractmethod
    def scan(self) -> Iterator[tuple[Channel, int, Data]]:
        """Yield the channel, the reception time in ns and the data of every message."""

    def add_fact(self, fact: str) -> None:
        """Add a fact once, although the bag is read several times."""
        if fact not in self.facts:
            self.facts.append(fact)

    def channels(self) -> dict[Channel, int]:
        """Return the number of messages of every channel that has any."""
        counts: dict[Channel, int] = {}
        for channel, _, _ in self.scan():
            counts[channel] = counts.get(channel, 0) + 1
        return counts

    def messages(self, channel: Channel) -> Iterator[tuple[int, bytes]]:
        """Yield the reception time in ns and the data of every message of a channel's topic and type."""
        unpacker = self.unpacker()
        for other, time, data in self.scan():
            if other.topic == channel.topic and other.type == channel.type:
                yield time, unpacker.message(bytes(data)) if other.encoding == "cdr" else bytes(data)


class JoinedBags(Bag):
    """The files of a split recording in order; path: of the archive that holds them."""

    def __init__(self, path: Path, bags: list[Bag], settings: Settings) -> None:
        super().__init__(path, settings)
        self.bags = bags

    def channels(self) -> dict[Channel, int]:
        """Return the number of messages of every channel of all files."""
        counts: dict[Channel, int] = {}
        for bag in self.bags:
            for channel, count in bag.channels().items():
                counts[channel] = counts.get(channel, 0) + count
        self.facts = list(dict.fromkeys(fact for bag in self.bags for fact in bag.facts))
        return counts

    def messages(self, channel: Channel) -> Iterator[tuple[int, bytes]]:
        """Yield the reception time in ns and the data of every message of a channel's topic and type."""
        for bag in self.bags:
            yield from bag.messages(channel)


def type_name(name: str) -> str:
    """Return a message type as ROS 1 writes it, `package/Name`, from either form."""
    return name.replace("/msg/", "/")


def damaged(reason: str, offset: int | None = None) -> InvalidDataError:
    """Return the error for a bag that cannot be read further."""
    reason = reason if offset is None else f"damaged at byte {offset}: {reason}"
    return unreadable("file", reason, "a complete bag")


class Unpacker:
    """Decompression that never yields more bytes than declared, nor more than its limits.

    max_part: bytes of one chunk or message; max_total: bytes of one pass through a bag.
    """

    def __init__(self, max_part: int, max_total: int) -> None:
        self.max_part, self.max_total, self.total = max_part, max_total, 0

    def count(self, size: int) -> None:
        """Count bytes that will be unpacked; raise TooLargeError."""
        if size > self.max_part:
            raise TooLargeError(f"The bag has a part of {size} bytes, expected at most {self.max_part}")
        self.total += size
        if self.total > self.max_total:
            raise TooLargeError(f"The bag unpacks to more than {self.max_total} bytes")

    def unpack(self, data: Data, compression: str, size: int) -> Data:
        """Decompress `data` into exactly `size` bytes; raise ValueError or OSError if it is damaged."""
        self.count(size)
        if compression in ("", "none"):
            unpacked = data
        elif compression == "bz2":
            unpacked = bz2.BZ2Decompressor().decompress(data, max_length=size + 1)
        elif compression in ("lz4", "zstd"):
            unpacked = pa.decompress(data, decompressed_size=size, codec=compression, asbytes=True) if size else b""
        else:
            raise ValueError(f"unknown compression {compression!r}, expected zstd, lz4, bz2 or none")
        if len(unpacked) != size:
            raise ValueError(f"a part has {len(unpacked)} bytes, but {size} are declared")
        return unpacked

    def message(self, data: bytes) -> bytes:
        """Return a message, decompressed if rosbag2 has compressed it."""
        if not data.startswith(b"\x28\xb5\x2f\xfd"):  # the start of zstd data; no CDR message starts like this
            return data
        try:
            with pa.CompressedInputStream(pa.BufferReader(data), "zstd") as stream:
                unpacked: bytes = stream.read(self.max_part + 1)
        except OSError as error:
            raise damaged(str(error)) from None
        self.count(len(unpacked))
        return unpacked
