"""What every kind of bag is read as: channels, and their messages in the order of their recording.

The bags are read by us, front to back, for three reasons: a recording that was cut off is read as far as it goes;
nothing is unpacked beyond a limit; and no code is generated out of message definitions, which come with the upload.
"""

from __future__ import annotations

import bz2
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa

from service.foundation.errors import InvalidDataError, TooLargeError, invalid_data
from service.foundation.settings import Settings

Data = bytes | memoryview
MAX_PART_BYTES = 64 * 1024 * 1024
"""Largest chunk or message of a bag, once unpacked."""


class Channel(NamedTuple):
    """One topic of one type.

    type: `package/Name`; encoding: of its messages, `cdr` or `ros1` or what is not read here; definition: of the type,
    as text, None where the bag does not hold it.
    """

    topic: str
    type: str
    encoding: str
    definition: str | None


class Bag(ABC):
    """A bag in one file. facts: what was noticed on the way, complete once it was read through."""

    def __init__(self, path: Path, settings: Settings) -> None:
        self.path, self.settings = path, settings
        self.facts: list[str] = []

    @abstractmethod
    def channels(self) -> dict[Channel, int]:
        """Number of messages of every channel that has any; raise InvalidDataError."""

    @abstractmethod
    def messages(self, channel: Channel) -> Iterator[tuple[int, bytes]]:
        """Time of reception in ns and data of every message of a channel's topic and type."""

    def unpacking(self) -> Unpacking:
        """What one pass through the bag may unpack."""
        return Unpacking(MAX_PART_BYTES, self.settings.max_unpacked_bytes)


class ScannedBag(Bag):
    """A bag that is read from front to back; `scan` says how."""

    @abstractmethod
    def scan(self) -> Iterator[tuple[Channel, int, Data]]:
        """Channel, time of reception in ns and data of every message."""

    def tell(self, fact: str) -> None:
        """Note a fact, once: a bag is read several times."""
        if fact not in self.facts:
            self.facts.append(fact)

    def channels(self) -> dict[Channel, int]:
        """Number of messages of every channel that has any."""
        counts: dict[Channel, int] = {}
        for channel, _, _ in self.scan():
            counts[channel] = counts.get(channel, 0) + 1
        return counts

    def messages(self, channel: Channel) -> Iterator[tuple[int, bytes]]:
        """Time of reception in ns and data of every message of a channel's topic and type."""
        unpacking = self.unpacking()
        for other, time, data in self.scan():
            if other.topic == channel.topic and other.type == channel.type:
                yield time, unpacking.message(bytes(data)) if other.encoding == "cdr" else bytes(data)


class JoinedBags(Bag):
    """The files that one recording was split into, one after the other; path: of the archive that they were in."""

    def __init__(self, path: Path, bags: list[Bag], settings: Settings) -> None:
        super().__init__(path, settings)
        self.bags = bags

    def channels(self) -> dict[Channel, int]:
        """Number of messages of every channel of all files."""
        counts: dict[Channel, int] = {}
        for bag in self.bags:
            for channel, count in bag.channels().items():
                counts[channel] = counts.get(channel, 0) + count
        self.facts = list(dict.fromkeys(fact for bag in self.bags for fact in bag.facts))
        return counts

    def messages(self, channel: Channel) -> Iterator[tuple[int, bytes]]:
        """Time of reception in ns and data of every message of a channel's topic and type."""
        for bag in self.bags:
            yield from bag.messages(channel)


def type_name(name: str) -> str:
    """A message type as ROS 1 writes it: `package/Name`, whether or not `msg` stands between."""
    return name.replace("/msg/", "/")


def damaged(what: str, offset: int | None = None) -> InvalidDataError:
    """Error for a bag that cannot be read on."""
    return invalid_data("file", what if offset is None else f"damaged at byte {offset}: {what}", "a complete bag")


class Unpacking:
    """Decompression that never yields more than was declared, nor more than the limits in all.

    most_at_once: bytes of one chunk or message; most: bytes of one pass through a bag.
    """

    def __init__(self, most_at_once: int, most: int) -> None:
        self.most_at_once, self.most, self.taken = most_at_once, most, 0

    def take(self, size: int) -> None:
        """Count bytes that are about to be unpacked; raise TooLargeError."""
        if size > self.most_at_once:
            raise TooLargeError(f"the bag has a part of {size} bytes, expected at most {self.most_at_once}")
        self.taken += size
        if self.taken > self.most:
            raise TooLargeError(f"the bag unpacks to more than {self.most} bytes")

    def unpack(self, data: Data, compression: str, size: int) -> Data:
        """Decompress `data` into exactly `size` bytes; raise ValueError or OSError where it is damaged."""
        self.take(size)
        if compression in ("", "none"):
            unpacked = data
        elif compression == "bz2":
            unpacked = bz2.BZ2Decompressor().decompress(data, max_length=size + 1)
        elif compression in ("lz4", "zstd"):
            unpacked = pa.decompress(data, decompressed_size=size, codec=compression, asbytes=True) if size else b""
        else:
            raise ValueError(f"compressed by {compression!r}, expected zstd, lz4, bz2 or none")
        if len(unpacked) != size:
            raise ValueError(f"a part of {len(unpacked)} bytes, {size} declared")
        return unpacked

    def message(self, data: bytes) -> bytes:
        """A message, which rosbag2 may have compressed by itself."""
        if not data.startswith(b"\x28\xb5\x2f\xfd"):  # rosbag2 compressed it by zstd; no CDR message begins so
            return data
        try:
            with pa.CompressedInputStream(pa.BufferReader(data), "zstd") as stream:
                unpacked: bytes = stream.read(self.most_at_once + 1)
        except OSError as error:
            raise damaged(str(error)) from None
        self.take(len(unpacked))
        return unpacked
