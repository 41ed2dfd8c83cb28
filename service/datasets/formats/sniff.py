"""What a file is by its content, whatever it is called."""

from __future__ import annotations

from pathlib import Path

from service.datasets.formats.json_rows import decode
from service.datasets.formats.lerobot import root_of
from service.datasets.formats.zips import open_zip
from service.foundation.errors import ServiceError
from service.foundation.settings import Settings

HEAD_BYTES = 64 * 1024
KINDS = {
    "csv": "CSV",
    "parquet": "Parquet",
    "npz": "NPZ",
    "json_lines": "JSON, one object a line",
    "json": "JSON",
    "lerobot": "a zip of a LeRobot data set",
    "rosbag1": "a ROS 1 bag",
    "rosbag2": "a ROS 2 bag",
    "mcap": "MCAP",
}
"""What is read here, in words."""
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


def sniff(path: Path, settings: Settings | None = None) -> str | None:
    """One of `KINDS`; None where the content is none of them, or cannot be told. Raises nothing of damaged files."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    for magic, kind in _MAGIC:
        if head.startswith(magic):
            return kind
    if head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return _zip(path, settings or Settings())
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


def _zip(path: Path, settings: Settings) -> str | None:
    try:
        with open_zip(path, settings, "a zip archive") as archive:
            names = archive.namelist()
    except ServiceError:
        return None
    if root_of(names) is not None:
        return "lerobot"
    if any(name.endswith((".db3", ".mcap", ".db3.zstd", ".mcap.zstd")) for name in names):
        return "rosbag2"
    if any(name.endswith(".bag") for name in names):
        return "rosbag1"
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
    while rest and (not (row := rest.partition("\n")[0].strip()) or line[0] in "#%"):
        line, _, rest = (row or line).lstrip("#%"), None, rest.partition("\n")[2]
    marks = [mark for mark in ",;\t| " if mark in line and mark in row] if rest else []
    return "csv" if marks and any(each.isdigit() for each in row) else None
