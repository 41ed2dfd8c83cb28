"""The messages of a bag: ROS 1 bags and sqlite3 files by `rosbags`, MCAP files by `mcap`; and of `ros2 topic echo`.

No index is used, so recordings that were cut off are read up to their end.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap import records
from mcap.exceptions import EndOfFile
from mcap.stream_reader import StreamReader
from rosbags.rosbag1.reader import Header, RecordType, decompressors, read_bytes, read_uint32
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from service.datasets.formats.table import first_line, unreadable
from service.datasets.formats.zips import decompress
from service.foundation.errors import InvalidDataError, ServiceError, invalid_data

MCAP_MAGIC = b"\x89MCAP0\r\n"
ROSBAG1_MAGIC = b"#ROSBAG V2.0\n"
SQLITE_MAGIC = b"SQLite format 3\0"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""The start of zstd data; no message in CDR encoding starts like this."""
CUT_OFF = "the last record is cut off or damaged: the recording is read up to there"


class Topic(NamedTuple):
    """A topic of one type. Publishers of the same topic and type are one."""

    name: str
    type: str
    """`package/Name`, as ROS 1 writes it."""
    encoding: str
    """Encoding of the messages: `cdr`, `ros1`, `json`, `protobuf` or `yaml` can be read."""
    language: str
    """Language of the definition: `ros1msg`, `ros2msg`, `ros2idl`, `protobuf`, …; "" if the bag has no definition."""
    definition: bytes
    """Definition of the type."""


Messages = Iterator[tuple[Topic, int, bytes]]
"""Topic, reception time in ns, and data."""


def read_messages(path: Path, facts: list[str]) -> Messages:
    """Yield all messages of a file in their order; raise InvalidDataError. facts: sentences are added to it, once."""
    with path.open("rb") as file:
        start = file.read(16)
        file.seek(0)
        read = next((each for magic, each in _READERS.items() if start.startswith(magic)), None)
        if read is None and re.match(rb"\s*[A-Za-z_]\w*:", start):
            read = _read_yaml
        if read is None:
            value, expected = f"not a bag (it begins with {start!r})", "a ROS 1 bag, a ROS 2 bag or an MCAP file"
            raise invalid_data("file", value if start else "empty", expected)
        try:
            yield from read(file)
        except (ServiceError, MemoryError):
            raise
        except Exception as error:  # the readers raise many kinds for damaged files
            place = file.tell()
            if file.read(1) and not isinstance(error, EndOfFile):
                raise damaged(f"damaged before byte {place}: {first_line(error)}") from None
            if CUT_OFF not in facts:
                facts.append(CUT_OFF)


def damaged(reason: str) -> InvalidDataError:
    """Return the error for a bag that cannot be read further."""
    return unreadable("file", reason, "a complete bag")


def type_name(name: str) -> str:
    """Return a message type as ROS 1 writes it, `package/Name`, from either form."""
    return name.replace("/msg/", "/")


def _read_rosbag1(file: BinaryIO) -> Messages:
    file.seek(len(ROSBAG1_MAGIC))
    return _records(file, {})


def _records(file: BinaryIO, topics: dict[int, Topic]) -> Messages:
    """Yield the messages among the records of a file, or of a chunk, from its place on."""
    while next_byte := file.read(1):
        file.seek(-len(next_byte), 1)
        header = Header.read(file)
        kind = header.get_uint8("op")
        if kind == RecordType.CONNECTION:
            about = Header.read(file)
            name, text = type_name(about.get_string("type")), about["message_definition"]
            topics[header.get_uint32("conn")] = Topic(header.get_string("topic"), name, "ros1", "ros1msg", text)
            continue
        if kind == RecordType.BAGHEADER and header.get("encryptor"):
            raise damaged("it is encrypted")
        content = read_bytes(file, read_uint32(file))
        if kind == RecordType.MSGDATA:
            yield topics[header.get_uint32("conn")], header.get_time("time"), content
        elif kind == RecordType.CHUNK:
            unpacked = decompressors[header.get_string("compression")](content)
            yield from _records(BytesIO(unpacked), topics)


def _read_sqlite(file: BinaryIO) -> Messages:
    reader = Sqlite3Reader(Path(file.name))
    reader.open()
    try:
        topics = {}
        for each in reader.connections:
            language = {"MSG": "ros2msg", "IDL": "ros2idl"}.get(each.msgdef.format.name, "")
            encoding = getattr(each.ext, "serialization_format", "")
            topics[each.id] = Topic(each.topic, type_name(each.msgtype), encoding, language, each.msgdef.data.encode())
        for connection, time, data in reader.messages(reader.connections):
            yield topics[connection.id], time, _unpacked(data)
    finally:
        reader.close()


def _unpacked(data: bytes) -> bytes:
    """Return a message, decompressed if rosbag2 has compressed it."""
    return bytes(decompress(BytesIO(data), "zstd").read()) if data.startswith(ZSTD_MAGIC) else data


def _read_mcap(file: BinaryIO) -> Messages:
    schemas: dict[int, records.Schema] = {}
    topics: dict[int, Topic] = {}
    size = os.fstat(file.fileno()).st_size
    for record in StreamReader(file, validate_crcs=True, record_size_limit=size).records:
        if isinstance(record, records.Message):
            topic = topics[record.channel_id]
            yield topic, record.log_time, _unpacked(record.data) if topic.encoding == "cdr" else record.data
        elif isinstance(record, records.Schema):
            schemas[record.id] = record
        elif isinstance(record, records.Channel):
            schema = schemas.get(record.schema_id) or records.Schema(id=0, name="", encoding="", data=b"")
            name = type_name(schema.name)
            topics[record.id] = Topic(record.topic, name, record.message_encoding, schema.encoding, schema.data)


def _read_yaml(file: BinaryIO) -> Messages:
    """Yield the documents that `ros2 topic echo` prints. They have no times of reception: 0."""
    topic, lines = Topic("echo", "YAML", "yaml", "", b""), list[bytes]()
    for line in file:
        if line.strip() != b"---":
            lines.append(line)
        elif lines:
            yield topic, 0, b"".join(lines)
            lines = []
    if b"".join(lines).strip():
        raise EndOfFile


_READERS: dict[bytes, Callable[[BinaryIO], Messages]] = {
    ROSBAG1_MAGIC: _read_rosbag1,
    SQLITE_MAGIC: _read_sqlite,
    MCAP_MAGIC: _read_mcap,
}
