"""Reading NPZ: named NumPy arrays, numbers and plain text only. Nothing is unpickled, nothing unpacked unmeasured."""

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
from service.datasets.formats.table import MAX_COLUMNS, Table, block_rows, checked_names, first_line, left_out
from service.datasets.formats.zips import ERRORS, measure, open_zip
from service.datasets.options import ReadOptions
from service.foundation.errors import invalid_data
from service.foundation.settings import Settings

ARRAYS = {"q": 2, "dq": 2, "ddq": 2, "tau": 2, "t": 1, "episode": 1, "dt": 0, "joint_names": 1}
"""Known arrays and their dimensions: q, dq, ddq, tau (N, n); t, episode (N,); dt (); joint_names (n,)."""
EXPECTED = "a complete NPZ archive"


@dataclass
class Stored:
    """An array in the archive: its member, what its header says, and where its numbers begin."""

    name: str
    member: zipfile.ZipInfo
    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype[Any]
    offset: int

    @property
    def width(self) -> int:
        """Columns of the table that it becomes."""
        return self.shape[1] if len(self.shape) == 2 else 1

    def columns(self) -> list[str]:
        """Their names: q1… of what is known, name[0]… of another array."""
        if len(self.shape) == 1:
            return [self.name]
        known = self.name in ARRAYS
        return [f"{self.name}{i + 1}" if known else f"{self.name}[{i}]" for i in range(self.width)]


@contextmanager
def open_npz(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open an NPZ archive as a table; raise InvalidDataError naming the array, or TooLargeError.

    Known are `ARRAYS`; every other array of one number or one row of numbers a sample becomes columns too, and what
    else there is is left out, which is a fact of the table.
    """
    with open_zip(path, EXPECTED) as archive, ExitStack() as files:
        members = archive.infolist()
        for member in members:
            if "/" in member.filename or not member.filename.endswith(".npy"):
                raise invalid_data("array", member.filename, "a plain name ending in .npy")
        if len(members) > MAX_COLUMNS:
            raise invalid_data("array", f"{len(members)} arrays", f"at most {MAX_COLUMNS}")
        measure(members, settings)
        arrays = {each.name: each for each in (_header(archive, member) for member in members)}
        rows = _rows(arrays)
        used, ignored = _choose(arrays, rows)
        joints = arrays.get("joint_names")
        step = None if "dt" not in arrays or "t" in arrays else _step(archive, arrays["dt"])
        names = checked_names((["t"] if step else []) + [name for each in used for name in each.columns()])
        facts = left_out(ignored, f"they are not {rows} numbers, or rows of numbers")
        yield Table(
            names,
            _blocks(archive, files, used, rows, step),
            joint_names=None if joints is None else _text(archive, joints),
            facts=facts,
        )


def _header(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> Stored:
    name = member.filename.removesuffix(".npy")
    try:
        with archive.open(member) as file:
            version = npy.read_magic(file)
            if version not in ((1, 0), (2, 0)):
                raise ValueError(f"format version {version}")
            read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
            shape, fortran, dtype = read(file)
            offset = file.tell()
    except Exception as error:  # NumPy parses the header as Python text and raises whatever its parser raises
        raise invalid_data(name, first_line(error), "a NumPy array") from None
    kinds = "U" if name == "joint_names" else "fiu"
    if name in ARRAYS and (dtype.kind not in kinds or not 0 < dtype.itemsize <= 1024 or len(shape) != ARRAYS[name]):
        raise invalid_data(
            name,
            f"of type {dtype} and {len(shape)} dimensions",
            f"{ARRAYS[name]} dimensions of plain " + ("text" if kinds == "U" else "numbers"),
        )
    size = member.file_size - offset
    if any(not 0 <= length <= size for length in shape):
        raise invalid_data(name, f"of shape {shape}", "as many values as the file holds")
    if not dtype.hasobject and math.prod(shape) * dtype.itemsize > size:
        raise invalid_data(name, "truncated", f"{math.prod(shape)} values, as its header says")
    return Stored(name, member, tuple(shape), bool(fortran), dtype, offset)


def _rows(arrays: dict[str, Stored]) -> int:
    """Samples N: as q has rows, or most arrays."""
    if "q" in arrays:
        return arrays["q"].shape[0]
    lengths = Counter(each.shape[0] for each in arrays.values() if each.dtype.kind in "fiu" and each.shape)
    if not lengths:
        raise invalid_data("array", ", ".join(arrays) or "none", "arrays q (N, n) and tau (N, n)")
    return max(lengths, key=lambda length: (lengths[length], length))


def _choose(arrays: dict[str, Stored], rows: int) -> tuple[list[Stored], list[str]]:
    """Arrays that become columns, and the names of those that do not."""
    used, ignored = [], []
    width = arrays["q"].shape[1] if "q" in arrays else None
    for name, array in arrays.items():
        if name in ARRAYS and (len(array.shape) != 2 or width is not None):
            shape = {2: (rows, width), 1: (rows,), 0: ()}[ARRAYS[name]] if name != "joint_names" else (width,)
            if shape not in (array.shape, (None,)):
                raise invalid_data(
                    name, f"of shape {array.shape}", f"shape {shape}, as q has {rows} rows and {width} joints"
                )
        if name in ("dt", "joint_names"):
            continue
        if array.dtype.kind in "fiu" and len(array.shape) in (1, 2) and array.shape[0] == rows and array.width:
            if array.fortran and array.width > 64:  # each column is unpacked by a reader of its own
                raise invalid_data(name, f"{array.width} columns in Fortran order", "C order: numpy.ascontiguousarray")
            used.append(array)
        else:
            ignored.append(name)
    return used, ignored


def _blocks(
    archive: zipfile.ZipFile, files: ExitStack, used: list[Stored], rows: int, step: float | None
) -> Iterator[Array]:
    """All arrays side by side, each read on by a reader of its own; step: of times, s, None where they are given."""
    readers = [_Reader(archive, files, each) for each in used]
    names = [name for each in used for name in each.columns()]
    episode = names.index("episode") if "episode" in names else None
    most = block_rows(len(names) + 1)
    begin, last = 0, np.nan
    for start in range(0, rows, most):
        block = np.concatenate([each.read(min(most, rows - start)) for each in readers], axis=1)
        if step is not None:
            row = np.arange(start, start + len(block))
            begins = np.zeros(len(row), np.int64)
            if episode is not None:  # times start anew with every episode
                changes = np.diff(block[:, episode], prepend=last) != 0
                begins = np.maximum.accumulate(np.where(changes, row, begin))
                begin, last = int(begins[-1]), float(block[-1, episode])
            block = np.column_stack([(row - begins) * step, block])
        yield block
    for each in readers:
        each.finish()


class _Reader:
    """Reads an array on, block after block; one column after another is read by one file each."""

    def __init__(self, archive: zipfile.ZipFile, files: ExitStack, array: Stored) -> None:
        self.array = array
        by_column = array.fortran and array.width > 1
        self.parts, self.width = (array.width, 1) if by_column else (1, array.width)
        self.files: list[IO[bytes]] = []
        with _named(array.name):
            for part in range(self.parts):
                file = files.enter_context(archive.open(array.member))
                file.seek(array.offset + part * array.shape[0] * array.dtype.itemsize)
                self.files.append(file)

    def read(self, rows: int) -> Array:
        """The next rows, (rows, columns)."""
        size = rows * self.width * self.array.dtype.itemsize
        out = np.empty((rows, self.array.width))
        with _named(self.array.name):
            for part, file in enumerate(self.files):
                data = file.read(size)
                if len(data) != size:
                    raise invalid_data(
                        self.array.name, "truncated", f"{math.prod(self.array.shape)} values, as its header says"
                    )
                values = np.frombuffer(data, self.array.dtype).reshape(rows, self.width)
                with np.errstate(over="ignore"):  # what a double cannot hold becomes infinite: it is found as that
                    out[:, part : part + self.width] = values
        return out

    def finish(self) -> None:
        """Read to the end, where the archive's checksum is compared."""
        with _named(self.array.name):
            while self.files[-1].read(1024 * 1024):
                pass


def _step(archive: zipfile.ZipFile, array: Stored) -> float:
    step = float(_values(archive, array))
    if not 0 < step < np.inf:
        raise invalid_data("dt", step, "a positive number of seconds")
    return step


def _text(archive: zipfile.ZipFile, array: Stored) -> tuple[str, ...]:
    try:
        return tuple(str(name) for name in _values(archive, array))
    except (SystemError, ValueError):
        raise invalid_data("joint_names", "not Unicode", "plain text") from None


def _values(archive: zipfile.ZipFile, array: Stored) -> np.ndarray[Any, Any]:
    """A small array as it is."""
    size = math.prod(array.shape) * array.dtype.itemsize
    if size > 1024 * 1024:
        raise invalid_data(array.name, f"of {size} bytes", "at most 1 MiB")
    with _named(array.name), archive.open(array.member) as file:
        file.seek(array.offset)
        return np.frombuffer(file.read(size), array.dtype).reshape(array.shape)


@contextmanager
def _named(name: str) -> Iterator[None]:
    """Errors of the archive become those of an array."""
    try:
        yield
    except ERRORS as error:
        raise invalid_data(name, first_line(error), EXPECTED) from None
