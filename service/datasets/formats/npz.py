"""Reading NPZ: named NumPy arrays of numbers and plain text. Nothing is unpickled, and sizes are checked first."""

from __future__ import annotations

import math
import zipfile
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from lipcore.data.samples import Array
from service.datasets.formats.table import (
    MAX_COLUMNS,
    Table,
    block_rows,
    clean_names,
    describe_unread,
    first_line,
    unreadable,
)
from service.datasets.formats.zips import ERRORS, check_unpacked_size, open_zip
from service.datasets.options import ReadOptions
from service.foundation.errors import invalid_data
from service.foundation.settings import Settings

ARRAYS = {"q": 2, "dq": 2, "ddq": 2, "tau": 2, "t": 1, "episode": 1, "dt": 0, "joint_names": 1}
"""Number of dimensions of the known arrays: q, dq, ddq, tau (N, n); t, episode (N,); dt (); joint_names (n,)."""
EXPECTED = "a complete NPZ archive"


@dataclass
class StoredArray:
    """An array in the archive: its member, its header, and the offset of its values in bytes."""

    name: str
    member: zipfile.ZipInfo
    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype[Any]
    offset: int

    @property
    def width(self) -> int:
        """Number of table columns."""
        return self.shape[1] if len(self.shape) == 2 else 1

    def columns(self) -> list[str]:
        """Return the names of its table columns: q1… for a known array, name[0]… for another."""
        if len(self.shape) == 1:
            return [self.name]
        known = self.name in ARRAYS
        return [f"{self.name}{i + 1}" if known else f"{self.name}[{i}]" for i in range(self.width)]


@contextmanager
def open_npz(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open an NPZ archive as a table; raise InvalidDataError that names the array, or TooLargeError.

    Besides the known `ARRAYS`, every array with one number or one row of numbers per sample becomes columns. Other
    arrays are not read, and the table's facts say so.
    """
    with open_zip(path, EXPECTED) as archive, ExitStack() as files:
        members = archive.infolist()
        for member in members:
            if "/" in member.filename or not member.filename.endswith(".npy"):
                raise invalid_data("array", member.filename, "a file name ending in .npy, without a folder")
        if len(members) > MAX_COLUMNS:
            value, expected = f"{len(members)} arrays", f"at most {MAX_COLUMNS}"
            raise invalid_data("array", value, expected, f"The archive has {value}, expected {expected}.")
        check_unpacked_size(members, settings)
        arrays = {each.name: each for each in (_read_header(archive, member) for member in members)}
        rows = _count_rows(arrays)
        used, ignored = _choose_arrays(arrays, rows)
        joints = arrays.get("joint_names")
        step = None if "dt" not in arrays or "t" in arrays else _read_step(archive, arrays["dt"])
        names = clean_names((["t"] if step else []) + [name for each in used for name in each.columns()])
        facts = describe_unread(ignored, f"they do not have {rows} numbers or rows of numbers")
        yield Table(
            names,
            _blocks(archive, files, used, rows, step),
            joint_names=None if joints is None else _read_text(archive, joints),
            facts=facts,
        )


def _read_header(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> StoredArray:
    name = member.filename.removesuffix(".npy")
    try:
        with archive.open(member) as file:
            version = npy.read_magic(file)
            if version not in ((1, 0), (2, 0)):
                raise ValueError(f"format version {version}")
            read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
            shape, fortran, dtype = read(file)
            offset = file.tell()
    except Exception as error:  # NumPy parses the header as Python text, which can raise any error
        raise unreadable(name, first_line(error), "a NumPy array") from None
    kinds = "U" if name == "joint_names" else "fiu"
    if name in ARRAYS and (dtype.kind not in kinds or not 0 < dtype.itemsize <= 1024 or len(shape) != ARRAYS[name]):
        raise invalid_data(
            name,
            f"an array of {dtype} with {len(shape)} dimensions",
            f"{ARRAYS[name]} dimensions of plain " + ("text" if kinds == "U" else "numbers"),
        )
    size = member.file_size - offset
    if any(not 0 <= length <= size for length in shape):
        raise invalid_data(name, f"of shape {shape}", "no more values than the file holds")
    if not dtype.hasobject and math.prod(shape) * dtype.itemsize > size:
        raise invalid_data(name, "truncated", f"{math.prod(shape)} values, as declared in its header")
    return StoredArray(name, member, tuple(shape), bool(fortran), dtype, offset)


def _count_rows(arrays: dict[str, StoredArray]) -> int:
    """Return the number of samples N: the rows of q, or else of most arrays."""
    if "q" in arrays:
        return arrays["q"].shape[0]
    lengths = Counter(each.shape[0] for each in arrays.values() if each.dtype.kind in "fiu" and each.shape)
    if not lengths:
        expected = "arrays q (N, n) and tau (N, n)"
        message = f"The archive has no arrays of numbers, expected {expected}."
        raise invalid_data("array", ", ".join(arrays) or "none", expected, message)
    return max(lengths, key=lambda length: (lengths[length], length))


def _choose_arrays(arrays: dict[str, StoredArray], rows: int) -> tuple[list[StoredArray], list[str]]:
    """Return the arrays that become columns, and the names of the others."""
    used, ignored = [], []
    width = arrays["q"].shape[1] if "q" in arrays else None
    for name, array in arrays.items():
        if name in ARRAYS and (len(array.shape) != 2 or width is not None):
            shape = {2: (rows, width), 1: (rows,), 0: ()}[ARRAYS[name]] if name != "joint_names" else (width,)
            if shape not in (array.shape, (None,)):
                raise invalid_data(
                    name, f"of shape {array.shape}", f"shape {shape} because q has {rows} rows and {width} joints"
                )
        if name in ("dt", "joint_names"):
            continue
        if array.dtype.kind in "fiu" and len(array.shape) in (1, 2) and array.shape[0] == rows and array.width:
            if array.fortran and array.width > 64:  # each column is unpacked by its own reader
                value = f"an array of {array.width} columns in Fortran order"
                raise invalid_data(name, value, "C order: convert it with numpy.ascontiguousarray")
            used.append(array)
        else:
            ignored.append(name)
    return used, ignored


def _blocks(
    archive: zipfile.ZipFile, files: ExitStack, used: list[StoredArray], rows: int, step: float | None
) -> Iterator[Array]:
    """Yield all arrays side by side in blocks; step: time step in s, None if the archive has times."""
    readers = [_Reader(archive, files, each) for each in used]
    names = [name for each in used for name in each.columns()]
    episode = names.index("episode") if "episode" in names else None
    step_rows = block_rows(len(names) + 1)
    begin, last = 0, np.nan
    for start in range(0, rows, step_rows):
        block = np.concatenate([each.read(min(step_rows, rows - start)) for each in readers], axis=1)
        if step is not None:
            row = np.arange(start, start + len(block))
            begins = np.zeros(len(row), np.int64)
            if episode is not None:  # times restart with every episode
                changes = np.diff(block[:, episode], prepend=last) != 0
                begins = np.maximum.accumulate(np.where(changes, row, begin))
                begin, last = int(begins[-1]), float(block[-1, episode])
            block = np.column_stack([(row - begins) * step, block])
        yield block
    for each in readers:
        each.finish()


class _Reader:
    """Reads an array in blocks of rows; an array in Fortran order has one open file per column."""

    def __init__(self, archive: zipfile.ZipFile, files: ExitStack, array: StoredArray) -> None:
        self.array = array
        by_column = array.fortran and array.width > 1
        self.parts, self.width = (array.width, 1) if by_column else (1, array.width)
        self.files: list[IO[bytes]] = []
        with _name_array(array.name):
            for part in range(self.parts):
                file = files.enter_context(archive.open(array.member))
                file.seek(array.offset + part * array.shape[0] * array.dtype.itemsize)
                self.files.append(file)

    def read(self, rows: int) -> Array:
        """Return the next rows, (rows, columns)."""
        size = rows * self.width * self.array.dtype.itemsize
        out = np.empty((rows, self.array.width))
        with _name_array(self.array.name):
            for part, file in enumerate(self.files):
                data = file.read(size)
                if len(data) != size:
                    raise invalid_data(
                        self.array.name, "truncated", f"{math.prod(self.array.shape)} values, as declared in its header"
                    )
                values = np.frombuffer(data, self.array.dtype).reshape(rows, self.width)
                with np.errstate(over="ignore"):  # values too large for a double become infinite
                    out[:, part : part + self.width] = values
        return out

    def finish(self) -> None:
        """Read to the end, so that zipfile compares the checksum."""
        with _name_array(self.array.name):
            while self.files[-1].read(1024 * 1024):
                pass


def _read_step(archive: zipfile.ZipFile, array: StoredArray) -> float:
    step = float(_read_values(archive, array))
    if not 0 < step < np.inf:
        raise invalid_data("dt", step, "a positive number of seconds")
    return step


def _read_text(archive: zipfile.ZipFile, array: StoredArray) -> tuple[str, ...]:
    try:
        return tuple(str(name) for name in _read_values(archive, array))
    except (SystemError, ValueError):
        raise invalid_data("joint_names", "not valid Unicode", "plain text") from None


def _read_values(archive: zipfile.ZipFile, array: StoredArray) -> np.ndarray[Any, Any]:
    """Read a small array as it is stored."""
    size = math.prod(array.shape) * array.dtype.itemsize
    if size > 1024 * 1024:
        raise invalid_data(array.name, f"an array of {size} bytes", "at most 1 MiB")
    with _name_array(array.name), archive.open(array.member) as file:
        file.seek(array.offset)
        return np.frombuffer(file.read(size), array.dtype).reshape(array.shape)


@contextmanager
def _name_array(name: str) -> Iterator[None]:
    """Turn errors of zipfile into an InvalidDataError that names the array."""
    try:
        yield
    except ERRORS as error:
        raise unreadable(name, first_line(error), EXPECTED) from None
