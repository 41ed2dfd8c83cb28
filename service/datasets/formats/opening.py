"""Opening a recording of any format as a table. The format is found from the content, not from the name."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np

from lipcore.data.samples import Array
from lipcore.extras import import_extra
from service.datasets.formats.compressed import MAGIC, unpacked
from service.datasets.formats.encoding import decode_head
from service.datasets.formats.joined import find_tables
from service.datasets.formats.json import MAX_LINE_BYTES, decode, open_json, open_json_lines
from service.datasets.formats.npz import open_npz
from service.datasets.formats.table import Table
from service.datasets.formats.zips import find_lerobot_folder, open_zip
from service.datasets.mapping.recognition import find_times
from service.datasets.options import ReadOptions
from service.foundation.errors import ServiceError, invalid_data, invalid_request
from service.foundation.settings import Settings

HEAD_BYTES = 64 * 1024
KINDS = {
    "csv": "CSV",
    "parquet": "Parquet",
    "npz": "NPZ",
    "json_lines": "JSON with one object per line",
    "json": "JSON",
    "lerobot": "a zip of a LeRobot data set",
    "joined": "a zip of text tables",
    "rosbag1": "a ROS 1 bag",
    "rosbag2": "a ROS 2 bag",
    "mcap": "MCAP",
    "yaml": "YAML of `ros2 topic echo`",
    "feather": "Feather",
    "hdf5": "HDF5",
    "mat": "a MATLAB file",
    "npy": "a NumPy array",
    "xlsx": "an Excel workbook",
    "gzip": "a file compressed with gzip",
    "zstd": "a file compressed with zstd",
}
"""Formats that can be read, in words."""
PACKED = {"gzip": "gzip", "zstd": "zstd", "single": "zip"}
"""Compression by format, of files that hold another one."""
SIMILAR_KINDS: tuple[set[str | None], ...] = ({"json", "json_lines"}, {"rosbag1", "rosbag2", "mcap"})
"""Formats that are confused so often that the report does not mention it."""
HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_MAGIC = (
    (b"PAR1", "parquet"),
    (b"SQLite format 3\0", "rosbag2"),
    (b"\x89MCAP0\r\n", "mcap"),
    (b"#ROSBAG V2.0\n", "rosbag1"),
    (b"ARROW1", "feather"),
    (HDF5_MAGIC, "hdf5"),
    (b"MATLAB 5.0 MAT-file", "mat"),
    (b"\x93NUMPY", "npy"),
    *MAGIC,
)
_UNSUPPORTED = (
    (b"FEA1", "Feather"),
    (b"\x80\x03", "a pickle"),
    (b"\x80\x04", "a pickle"),
    (b"\x80\x05", "a pickle"),
    (b"BZh", "compressed with bzip2"),
    (b"\xfd7zXZ\0", "compressed with xz"),
    (b"7z\xbc\xaf\x27\x1c", "a 7z archive"),
    (b"Rar!", "a RAR archive"),
    (b"\x89PNG", "an image"),
    (b"\xff\xd8\xff", "an image"),
    (b"%PDF", "PDF"),
    (b"\xd0\xcf\x11\xe0", "an Office document"),
)
Opener = Callable[[Path, ReadOptions, Settings], AbstractContextManager[Table]]


def sniff(path: Path) -> str | None:
    """Return the format, a key of `KINDS`, or None if it is unknown; damaged files raise no error."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    for magic, kind in _MAGIC:
        if head.startswith(magic):
            return kind
    if head[512:].startswith(HDF5_MAGIC):  # MATLAB 7.3
        return "hdf5"
    if head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return _sniff_zip(path)
    return _sniff_text(head)


def name_unsupported(path: Path) -> str | None:
    """Return the format in words if it is known but cannot be read."""
    with path.open("rb") as file:
        head = file.read(512)
    for magic, kind in _UNSUPPORTED:
        if head.startswith(magic):
            return kind
    if head.startswith(b"PK"):
        return "a zip archive that is damaged or holds other files"
    return None


def _sniff_zip(path: Path) -> str | None:
    try:
        with open_zip(path, "a zip archive") as archive:
            names = archive.namelist()
    except ServiceError:
        return None
    if find_lerobot_folder(names) is not None:
        return "lerobot"
    if any(name.endswith((".db3", ".mcap", ".db3.zstd", ".mcap.zstd")) for name in names):
        return "rosbag2"
    if any(name.endswith(".bag") for name in names):
        return "rosbag1"
    if find_tables(names):
        return "joined"
    if "xl/workbook.xml" in names:
        return "xlsx"
    if names and all(name.endswith(".npy") for name in names):
        return "npz"
    return "single" if sum(not name.endswith("/") for name in names) == 1 else None


def _sniff_text(head: bytes) -> str | None:
    """Return "json", "json_lines", "yaml" or "csv" if the head of a file is such text."""
    found = decode_head(head, len(head) < HEAD_BYTES)
    text = "" if found is None else found[1].lstrip()
    if not text or "\0" in text or text[0] == "<":
        return None
    if text[0] == "[":
        return "json"
    if text[0] == "{":
        line, _, rest = text.partition("\n")
        try:
            row = decode(line.encode())
        except ValueError:
            return "json_lines" if len(head) == HEAD_BYTES and not rest else "json"
        if rest.strip():
            return "json_lines"
        return "json" if any(isinstance(value, list | dict) for value in row.values()) else "json_lines"
    if re.match(r"[A-Za-z_]\w*:\s", text) and re.search(r"(?m)^---\s*$", text):
        return "yaml"
    lines = (line for line in text.splitlines() if line.strip(" #%"))
    return "csv" if any(re.search(r"\d", line) and re.search(r"\S[,;\t| ]\s*\S", line) for line in lines) else None


@contextmanager
def open_table(path: Path, kind: str | None, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a recording as a table; raise InvalidDataError, TooLargeError or MissingExtraError.

    kind: the declared format, a key of `KINDS` or "zip", or None. A file with content of another format is read as
    that, and the table's facts say so. If its format cannot be read, the error names both.
    """
    if path.stat().st_size == 0:
        raise invalid_data("file", "empty", KINDS.get(kind or "", "a recording"))
    actual = _decide_kind(path, kind)
    if actual in PACKED:
        with unpacked(path, PACKED[actual], settings) as inner:
            if sniff(inner) in PACKED:
                raise invalid_data("file", "compressed twice", "a recording, or one that is compressed once")
            with open_table(inner, None, options, settings) as table:
                table.facts.insert(0, f"the file was unpacked with {PACKED[actual]}")
                yield table
        return
    with _open(path, actual, options, settings) as table:
        if options.dt is not None:
            _add_times(table, options.dt)
        if kind in KINDS and kind != actual and not any({kind, actual} <= family for family in SIMILAR_KINDS):
            table.facts.insert(0, f"the file was sent as {KINDS[kind]}, but was read as {KINDS[actual]}")
        yield table


def _add_times(table: Table, step: float) -> None:
    """Add times `step` s apart to a table; raise InvalidRequestError if it has times."""
    if times := find_times(table.names):
        raise invalid_request("dt", f"{step:g}", f"no `dt` because column {times[0].name} holds times")
    blocks = table.blocks

    def timed() -> Iterator[Array]:
        row = 0
        for block in blocks:
            yield np.column_stack([step * np.arange(row, row + len(block)), block])
            row += len(block)

    table.names, table.blocks = ("t", *table.names), timed()
    table.facts.append(f"times are counted in steps of {step:g} s, as set by `dt`")


def _decide_kind(path: Path, kind: str | None) -> str:
    """Return the format to read a file as."""
    actual = sniff(path)
    if actual is not None:
        if (kind, actual) == ("json_lines", "json") and not _starts_with(path, b"["):
            with path.open("rb") as file:  # after a damaged first line, JSON lines look like one document
                line = file.readline(MAX_LINE_BYTES)
                return "json_lines" if len(line.strip()) > 1 and line.endswith(b"\n") and file.read(1) else actual
        return actual
    other = name_unsupported(path)
    if kind in KINDS and (
        other is None or (kind in ("npz", "lerobot", "joined", "rosbag2") and _starts_with(path, b"PK"))
    ):
        return kind  # the reader of that format gives the best error
    sent = f" (sent as {KINDS[kind]})" if kind in KINDS else ""
    raise invalid_data(
        "file",
        f"{other or 'in an unknown format'}{sent}",
        "CSV, Parquet, Feather, NPZ, JSON, HDF5, MATLAB, Excel, a ROS 1 or ROS 2 bag, MCAP, one of these in gzip, zstd "
        "or zip, or a zip of a LeRobot data set, a bag or text tables",
    )


def _starts_with(path: Path, magic: bytes) -> bool:
    with path.open("rb") as file:
        return file.read(64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(magic)


def _open(path: Path, kind: str, options: ReadOptions, settings: Settings) -> AbstractContextManager[Table]:
    own: dict[str, Opener] = {"npz": open_npz, "json_lines": open_json_lines, "json": open_json}
    if kind in own:
        return own[kind](path, options, settings)
    import_extra("pyarrow", "ingest")  # the readers below need it
    module = {"hdf5": "arrays", "mat": "arrays", "npy": "arrays", "xlsx": "workbook"}.get(kind, kind)
    if kind in ("rosbag1", "rosbag2", "mcap", "yaml"):
        module, kind = "bags.reading", "bag"
    opener: Opener = getattr(import_extra(f"service.datasets.formats.{module}", "ingest"), f"open_{kind}")
    return opener(path, options, settings)
