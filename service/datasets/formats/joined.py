"""Reading a zip of text tables that are one recording: joined side by side, or one after the other.

Tables such as positions.txt and torques.txt have one row per sample each. The columns of a file without column names
get names from the file name. Tables with the same columns are parts in time, or one joint each: then the file's name is
the joint's.
"""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

import numpy as np

from lipcore.data.samples import Array
from service.contract.media_types import SUFFIXES
from service.datasets.formats.table import Table, block_rows, clean_names, first_line, unreadable
from service.datasets.formats.zips import (
    ERRORS,
    add_member,
    check_unpacked_size,
    numbers_in_name,
    open_zip,
)
from service.datasets.mapping.recognition import find_times, interpret_name, is_episode
from service.datasets.mapping.vocabulary import COMMANDED, MEASURED, find_quantity, split_words
from service.datasets.options import ReadOptions
from service.foundation.errors import ServiceError, invalid_data
from service.foundation.settings import Settings

ENDINGS = tuple(suffix for suffix, kind in SUFFIXES.items() if kind == "csv")
EXPECTED = f"a zip of files that end in {', '.join(ENDINGS)}"


def find_tables(names: Sequence[str]) -> list[str]:
    """Return the members to join, in order; an empty list if there are fewer than two, or any other file."""
    files = [name for name in names if not name.endswith("/") and not name.startswith("__MACOSX/")]
    return files if len(files) > 1 and all(name.lower().endswith(ENDINGS) for name in files) else []


@dataclass
class Part:
    """A member of the archive with its table."""

    name: str
    table: Table
    kept: list[int]
    """Indices of the columns to keep; a time column that an earlier member has is not kept."""


@contextmanager
def open_joined(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a zip of text tables as one table; raise InvalidDataError that names the member, or TooLargeError.

    Columns come in the order of the members. A file without column names gets them from `options.column_names`, which
    names the columns of all such files in order, or else from the quantity in its file name, for joints 1..n.
    """
    from service.datasets.formats.csv import open_csv  # noqa: PLC0415 - it imports pyarrow

    with TemporaryDirectory(dir=path.parent) as folder, ExitStack() as stack:
        with open_zip(path, EXPECTED) as archive:
            files = _unpacked(archive, Path(folder), settings)
        left = None if options.column_names is None else list(options.column_names)
        parts: list[Part] = []
        known: set[str] = set()
        tables: dict[str, Table] = {}
        for name, file in files.items():
            try:
                tables[name] = stack.enter_context(open_csv(file, options, settings, ColumnNamer(name, left)))
            except ServiceError as error:
                raise add_member(name, error) from None
        if left:
            value, expected = f"{len(left)} names too many", "one name per column of the files without column names"
            raise invalid_data("column_names", value, expected, f"`column_names` has {value}, expected {expected}.")
        if len({frozenset(table.names) for table in tables.values()}) == 1:
            starts = {name: _first_time(table) for name, table in tables.items()}
            if not _are_joints(next(iter(tables.values())), list(starts.values())):
                yield _one_after_the_other(tables, starts)
                return
            for name, table in tables.items():
                _name_joint(table, PurePosixPath(name).stem)
        facts = [f"{len(files)} files were joined side by side: {', '.join(files)}"]
        for name, table in tables.items():
            repeated = known & {table.names[index] for clock in find_times(table.names) for index, _ in clock.parts}
            parts.append(Part(name, table, [i for i, each in enumerate(table.names) if each not in repeated]))
            known |= set(table.names)
        names = clean_names([part.table.names[i] for part in parts for i in part.kept])
        units = {name: unit for part in parts for name, unit in part.table.units.items()}
        joined = Table(names, iter(()), units=units, facts=facts)
        joined.blocks = _side_by_side(parts, len(names), joined)
        yield joined


def _first_time(table: Table) -> float | None:
    """Return the time of a table's first row, in the unit of its column; None without times."""
    clock = next(iter(find_times(table.names)), None)
    first = next(table.blocks, None)
    if first is None:
        return None
    table.blocks = chain([first], table.blocks)
    return None if clock is None else float(first[0, clock.parts[0][0]])


def _are_joints(table: Table, starts: Sequence[float | None]) -> bool:
    """Return whether tables with these columns are a joint each: no column names one, and all begin together."""
    readings = [reading for name in table.names for reading in interpret_name(name)[:1]]
    return bool(readings) and not any(reading.joint for reading in readings) and len(set(starts)) == 1


def _name_joint(table: Table, joint: str) -> None:
    times = {index for clock in find_times(table.names) for index, _ in clock.parts}
    new = [name if index in times else f"{joint}/{name}" for index, name in enumerate(table.names)]
    table.units = {new[table.names.index(name)]: unit for name, unit in table.units.items()}
    table.names = tuple(new)


def _one_after_the_other(tables: dict[str, Table], starts: dict[str, float | None]) -> Table:
    """Return tables with the same columns as one, in the order of their times, else of their names.

    If their times do not go on from one to the next, each is an episode.
    """
    order = list(tables)
    if None not in starts.values() and len(set(starts.values())) == len(order):
        order.sort(key=lambda name: (starts[name] or 0.0, name))
        episodes = False
    else:
        order.sort(key=numbers_in_name)
        episodes = not any(map(is_episode, tables[order[0]].names))
    names = tables[order[0]].names
    facts = [f"{len(order)} files were joined one after the other: {', '.join(order)}"]

    def blocks() -> Iterator[Array]:
        for number, name in enumerate(order):
            table = tables[name]
            places = [table.names.index(each) for each in names]
            try:
                for block in table.blocks:
                    chosen = block[:, places]
                    yield np.column_stack([np.full(len(block), float(number)), chosen]) if episodes else chosen
            except ServiceError as error:
                raise add_member(name, error) from None
            joined.facts += [f"{name}: {fact}" for fact in table.facts]

    joined = Table(("episode", *names) if episodes else names, iter(()), units=tables[order[0]].units, facts=facts)
    joined.blocks = blocks()
    return joined


class ColumnNamer:
    """Names the columns of a member without column names: the next ones of the option, or by the file name."""

    def __init__(self, member: str, left: list[str] | None) -> None:
        self.member, self.left = PurePosixPath(member), left

    def __call__(self, width: int) -> tuple[str, ...]:
        """Return names for `width` columns; raise InvalidDataError if there are none."""
        if self.left is not None:
            if len(self.left) < width:
                value, expected = f"{len(self.left)} names left", f"{width}, one per column"
                raise invalid_data("column_names", value, expected, f"`column_names` has {value}, expected {expected}.")
            taken, self.left[:] = self.left[:width], self.left[width:]
            return tuple(taken)
        stem = self.member.stem
        if width == 1 and find_times([stem]):
            return ("t",)
        parts = split_words(stem)
        subject = find_quantity(parts)
        if subject is None:
            expected = (
                "column names in its first line, or a file name that says what it holds, such as positions.txt. Or set "
                "column_names=t,q1..q7,tau1..tau7 for all columns of such files in order"
            )
            raise invalid_data("header", "missing", expected)
        expressly = subject.kind == "current" or any(word.text in COMMANDED | MEASURED for word in parts)
        pattern = f"{stem}_" if expressly else subject.quantity
        return tuple(f"{pattern}{joint}" for joint in range(1, width + 1))


def _unpacked(archive: zipfile.ZipFile, folder: Path, settings: Settings) -> dict[str, Path]:
    """Unpack the tables; return the new file of each member."""
    members = [archive.getinfo(name) for name in find_tables(archive.namelist())]
    if not members:
        raise invalid_data("file", "an archive of other files", EXPECTED)
    check_unpacked_size(members, settings)
    files = {}
    for index, member in enumerate(members):
        files[member.filename] = folder / f"{index}.txt"
        try:
            with archive.open(member) as source, files[member.filename].open("xb") as target:
                shutil.copyfileobj(source, target)
        except ERRORS as error:
            raise unreadable(member.filename, first_line(error), "a member that can be unpacked") from None
    return files


def _side_by_side(parts: Sequence[Part], width: int, joined: Table) -> Iterator[Array]:
    """Yield the blocks of all parts side by side; raise InvalidDataError if their rows or times differ."""
    readers = [_RowReader(part) for part in parts]
    row = 0
    while (count := min([block_rows(width), *(reader.available() for reader in readers)])) > 0:
        taken = [reader.take(count) for reader in readers]
        _check_times(parts, taken, row)
        row += count
        yield np.hstack([block[:, part.kept] for part, block in zip(parts, taken, strict=True)])
    for reader in readers:
        joined.facts += [f"{reader.part.name}: {fact}" for fact in reader.part.table.facts]
    totals = [row + reader.count_rest() for reader in readers]
    for part, total in zip(parts, totals, strict=True):
        if total != totals[0]:
            raise invalid_data(part.name, f"a table of {total} rows", f"{totals[0]} rows, like {parts[0].name}")


def _check_times(parts: Sequence[Part], taken: Sequence[Array], row: int) -> None:
    first: dict[str, tuple[str, Array]] = {}
    for part, block in zip(parts, taken, strict=True):
        for index, name in enumerate(part.table.names):
            known = first.setdefault(name, (part.name, block[:, index]))
            if index in part.kept:
                continue
            other = ~((known[1] == block[:, index]) | (np.isnan(known[1]) & np.isnan(block[:, index])))
            if other.any():
                place = int(other.argmax())
                where = f"{part.name}: {name}, row {row + place + 1}"
                raise invalid_data(where, f"{block[place, index]:.15g}", f"{known[1][place]:.15g}, as in {known[0]}")


class _RowReader:
    """Reads the rows of a part, any number at a time."""

    def __init__(self, part: Part) -> None:
        self.part, self._block = part, np.empty((0, len(part.table.names)))

    def available(self) -> int:
        """Return the number of rows of the current block; 0 at the end."""
        if len(self._block) == 0:
            try:
                self._block = next(self.part.table.blocks, self._block)
            except ServiceError as error:
                raise add_member(self.part.name, error) from None
        return len(self._block)

    def take(self, count: int) -> Array:
        """Return the next rows of the current block."""
        taken, self._block = self._block[:count], self._block[count:]
        return taken

    def count_rest(self) -> int:
        """Read to the end; return the number of rows."""
        count = 0
        while here := self.available():
            count += here
            self._block = self._block[:0]
        return count
