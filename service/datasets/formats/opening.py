"""Any recording as a table: by what it is said to be, or by what it turns out to be."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import cast

from service.datasets.formats.csv import open_csv
from service.datasets.formats.json_lines import open_json, open_json_lines
from service.datasets.formats.lerobot import open_lerobot
from service.datasets.formats.npz import open_npz
from service.datasets.formats.parquet import open_parquet
from service.datasets.formats.sniff import KINDS, foreign, sniff
from service.datasets.formats.table import Table
from service.datasets.options import ReadOptions
from service.foundation.errors import invalid_data
from service.foundation.settings import Settings

Opener = Callable[[Path, ReadOptions, Settings], AbstractContextManager[Table]]
OPENERS: dict[str, Opener] = {
    "csv": open_csv,
    "parquet": open_parquet,
    "npz": open_npz,
    "json_lines": open_json_lines,
    "json": open_json,
    "lerobot": open_lerobot,
}
ZIPPED = ("npz", "lerobot", "rosbag2")
ALIKE: tuple[set[str | None], ...] = ({"json", "json_lines"}, {"rosbag1", "rosbag2", "mcap"})
"""Kinds that are taken for one another so often that it is not worth telling."""
READ = "CSV, Parquet, NPZ, JSON, a bag of ROS 1 or 2, MCAP, or a zip of a LeRobot data set or a bag"


@contextmanager
def open_table(path: Path, kind: str | None, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a recording as a table; raise InvalidDataError or TooLargeError.

    kind: what it is said to be, one of `sniff.KINDS` or "zip", None where nobody says. Where its content is of another
    kind it is read as that, which is a fact of the table; where it is none that is read here, the error names both.
    """
    if path.stat().st_size == 0:
        raise invalid_data("file", "empty", KINDS.get(kind or "", "a recording"))
    actual = _kind(path, kind, settings)
    with _open(path, actual, options, settings) as table:
        if kind in KINDS and kind != actual and not any({kind, actual} <= family for family in ALIKE):
            table.facts.insert(0, f"sent as {KINDS[kind]}, but is {KINDS[actual]}: read as that")
        yield table


def _kind(path: Path, kind: str | None, settings: Settings) -> str:
    """What a file is to be read as."""
    found = sniff(path, settings)
    if found is not None:
        if (kind, found) == ("json_lines", "json") and not _starts(path, b"["):
            with path.open("rb") as file:  # a damaged first line makes lines of JSON look like a document
                line = file.readline(settings.max_json_line_bytes)
                return "json_lines" if len(line.strip()) > 1 and line.endswith(b"\n") and file.read(1) else found
        return found
    other = foreign(path)
    if kind in KINDS and (other is None or (kind in ZIPPED and _starts(path, b"PK"))):
        return kind  # whoever reads that kind says best what is wrong with it
    said = f" (sent as {KINDS[kind]})" if kind in KINDS else ""
    raise invalid_data("file", f"{other or 'of no known kind'}{said}", READ)


def _starts(path: Path, magic: bytes) -> bool:
    with path.open("rb") as file:
        return file.read(64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(magic)


def _open(path: Path, kind: str, options: ReadOptions, settings: Settings) -> AbstractContextManager[Table]:
    if kind in OPENERS:
        return OPENERS[kind](path, options, settings)
    from service.datasets.formats.bags.opening import BagKind, open_bag  # noqa: PLC0415, as most uploads are no bags

    return open_bag(path, cast(BagKind, kind), options, settings)
