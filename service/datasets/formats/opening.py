"""Any recording as a table: what a file is by its content, whatever it is called or sent as."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from importlib import import_module
from pathlib import Path
from typing import cast

import numpy as np

from lipcore.data.samples import Array
from lipcore.extras import import_extra
from service.datasets.formats.joined import tables_of
from service.datasets.formats.json import MAX_LINE_BYTES, decode, open_json, open_json_lines
from service.datasets.formats.npz import open_npz
from service.datasets.formats.table import Table
from service.datasets.formats.zips import open_zip, root_of
from service.datasets.mapping.recognition import clocks
from service.datasets.options import ReadOptions
from service.foundation.errors import ServiceError, invalid_data, invalid_request
from service.foundation.settings import Settings

HEAD_BYTES = 64 * 1024
KINDS = {
    "csv": "CSV",
    "parquet": "Parquet",
    "npz": "NPZ",
    "json_lines": "JSON, one object a line",
    "json": "JSON",
    "lerobot": "a zip of a LeRobot data set",
    "joined": "a zip of tables",
    "rosbag1": "a ROS 1 bag",
    "rosbag2": "a ROS 2 bag",
    "mcap": "MCAP",
}
"""What is read here, in words."""
ALIKE: tuple[set[str | None], ...] = ({"json", "json_lines"}, {"rosbag1", "rosbag2", "mcap"})
"""Kinds that are taken for one another so often that it is not worth telling."""
_MAGIC = (
    (b"PAR1", "parquet"),
    (b"SQLite format 3\0", "rosbag2"),
    (b"\x89MCAP0\r\n", "mcap"),
    (b"#ROSBAG V2.0\n", "rosbag1"),
)
_FOREIGN = (
    (b"\x89HDF\r\n\x1a\n", "HDF5"),
    (b"MATLAB 5.0 MAT-file", "MATLAB"),
    (b"ARROW1", "an Arrow file"),
    (b"FEA1", "Feather"),
    (b"\x93NUMPY", "one NumPy array"),
    (b"\x80\x03", "a pickle"),
    (b"\x80\x04", "a pickle"),
    (b"\x80\x05", "a pickle"),
    (b"\x1f\x8b", "compressed by gzip"),
    (b"\x28\xb5\x2f\xfd", "compressed by zstd"),
    (b"BZh", "compressed by bzip2"),
    (b"\xfd7zXZ\0", "compressed by xz"),
    (b"7z\xbc\xaf\x27\x1c", "a 7z archive"),
    (b"Rar!", "a RAR archive"),
    (b"\xff\xfe", "text in UTF-16"),
    (b"\xfe\xff", "text in UTF-16"),
    (b"\x89PNG", "a picture"),
    (b"\xff\xd8\xff", "a picture"),
    (b"%PDF", "PDF"),
    (b"\xd0\xcf\x11\xe0", "an Office document"),
)
Opener = Callable[[Path, ReadOptions, Settings], AbstractContextManager[Table]]


def sniff(path: Path) -> str | None:
    """One of `KINDS`; None where the content is none of them, or cannot be told. Raises nothing of damaged files."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    for magic, kind in _MAGIC:
        if head.startswith(magic):
            return kind
    if head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return _zip(path)
    return _text(head)


def foreign(path: Path) -> str | None:
    """What a file is in words, where that is known and not read here."""
    with path.open("rb") as file:
        head = file.read(512)
    for magic, kind in _FOREIGN:
        if head.startswith(magic):
            return kind
    if head.startswith(b"PK"):
        return "an Excel workbook" if b"[Content_Types].xml" in head else "a zip archive, damaged or of other files"
    return None


def _zip(path: Path) -> str | None:
    try:
        with open_zip(path, "a zip archive") as archive:
            names = archive.namelist()
    except ServiceError:
        return None
    if root_of(names) is not None:
        return "lerobot"
    if any(name.endswith((".db3", ".mcap", ".db3.zstd", ".mcap.zstd")) for name in names):
        return "rosbag2"
    if any(name.endswith(".bag") for name in names):
        return "rosbag1"
    if tables_of(names):
        return "joined"
    return "npz" if names and all(name.endswith(".npy") for name in names) else None


def _text(head: bytes) -> str | None:
    """JSON or CSV, where the head of a file is text."""
    try:
        text = head.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if error.start < len(head) - 4 or len(head) < HEAD_BYTES:
            return None
        text = head[: error.start].decode("utf-8-sig")  # cut within a character
    text = text.lstrip()
    if not text or "\0" in text:
        return None
    line, _, rest = text.partition("\n")
    if text[0] == "[":
        return "json"
    if text[0] == "{":
        try:
            row = decode(line.encode())
        except ValueError:
            return "json_lines" if len(head) == HEAD_BYTES and not rest else "json"
        if rest.strip():
            return "json_lines"
        return "json" if any(isinstance(value, list | dict) for value in row.values()) else "json_lines"
    # (of a line of marks nothing is left)
    while rest and (not (row := rest.partition("\n")[0].strip()) or line[:1] in "#%"):
        line, _, rest = (row or line).lstrip("#%"), None, rest.partition("\n")[2]
    marks = [mark for mark in ",;\t| " if mark in line and mark in row] if rest else []
    return "csv" if marks and any(each.isdigit() for each in row) else None


@contextmanager
def open_table(path: Path, kind: str | None, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a recording as a table; raise InvalidDataError, TooLargeError or MissingExtraError.

    kind: what it is said to be, one of `KINDS` or "zip", None where nobody says. Where its content is of another
    kind it is read as that, which is a fact of the table; where it is none that is read here, the error names both.
    """
    if path.stat().st_size == 0:
        raise invalid_data("file", "empty", KINDS.get(kind or "", "a recording"))
    actual = _kind(path, kind)
    with _open(path, actual, options, settings) as table:
        if options.dt is not None:
            _count_time(table, options.dt)
        if kind in KINDS and kind != actual and not any({kind, actual} <= family for family in ALIKE):
            table.facts.insert(0, f"sent as {KINDS[kind]}, but is {KINDS[actual]}: read as that")
        yield table


def _count_time(table: Table, step: float) -> None:
    """Give a table without times those of rows that are `step` s apart; raise InvalidRequestError where it has some."""
    if times := clocks(table.names):
        raise invalid_request("dt", f"{step:g}", f"none, as column {times[0].name} holds times")
    blocks = table.blocks

    def timed() -> Iterator[Array]:
        row = 0
        for block in blocks:
            yield np.column_stack([step * np.arange(row, row + len(block)), block])
            row += len(block)

    table.names, table.blocks = ("t", *table.names), timed()
    table.facts.append(f"times are counted in steps of {step:g} s, as the upload says")


def _kind(path: Path, kind: str | None) -> str:
    """What a file is to be read as."""
    actual = sniff(path)
    if actual is not None:
        if (kind, actual) == ("json_lines", "json") and not _starts(path, b"["):
            with path.open("rb") as file:  # a damaged first line makes lines of JSON look like a document
                line = file.readline(MAX_LINE_BYTES)
                return "json_lines" if len(line.strip()) > 1 and line.endswith(b"\n") and file.read(1) else actual
        return actual
    other = foreign(path)
    if kind in KINDS and (other is None or (kind in ("npz", "lerobot", "joined", "rosbag2") and _starts(path, b"PK"))):
        return kind  # whoever reads that kind says best what is wrong with it
    sent = f" (sent as {KINDS[kind]})" if kind in KINDS else ""
    raise invalid_data(
        "file",
        f"{other or 'of no known kind'}{sent}",
        "CSV, Parquet, NPZ, JSON, a bag of ROS 1 or 2, MCAP, or a zip of a LeRobot data set, a bag, or tables of text",
    )


def _starts(path: Path, magic: bytes) -> bool:
    with path.open("rb") as file:
        return file.read(64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(magic)


def _open(path: Path, kind: str, options: ReadOptions, settings: Settings) -> AbstractContextManager[Table]:
    own: dict[str, Opener] = {"npz": open_npz, "json_lines": open_json_lines, "json": open_json}
    if kind in own:
        return own[kind](path, options, settings)
    import_extra("pyarrow", "ingest")  # what is imported from here on stands on it
    if kind in ("csv", "parquet", "lerobot", "joined"):
        opener: Opener = getattr(import_module(f"service.datasets.formats.{kind}"), f"open_{kind}")
        return opener(path, options, settings)
    from service.datasets.formats.bags.reading import BagKind, open_bag  # noqa: PLC0415

    return open_bag(path, cast(BagKind, kind), options, settings)
