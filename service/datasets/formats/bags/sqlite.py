"""Reading the sqlite3 files of rosbag2, with or without the metadata.yaml that a directory has."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing

from service.datasets.formats.bags.container import Bag, Channel, damaged, type_name

MAGIC = b"SQLite format 3\x00"


ERRORS = (sqlite3.Error, UnicodeDecodeError)
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
        except ERRORS as error:
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
        except ERRORS as error:
            raise damaged(str(error)) from None

    def _connect(self) -> sqlite3.Connection:
        # immutable: no journal beside the file is looked for, and nothing is locked
        database = sqlite3.connect(f"{self.path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
        try:
            database.text_factory = _text
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, self.settings.max_bag_part_bytes)
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
