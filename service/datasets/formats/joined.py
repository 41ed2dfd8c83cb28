"""Files that belong together, joined side by side: positions.txt, velocities.txt and torques.txt, in a zip.

Each is a table of text with a row a sample. One without column names is named by what its own name says it holds.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

import numpy as np

from lipcore.data.samples import Array
from service.contract.media_types import SUFFIXES
from service.datasets.formats.table import Table, block_rows, checked_names, first_line
from service.datasets.formats.zips import ERRORS, PIECE, measure, open_zip, within
from service.datasets.mapping.recognition import clocks
from service.datasets.mapping.vocabulary import COMMANDED, MEASURED, mention, words
from service.datasets.options import ReadOptions
from service.foundation.errors import ServiceError, invalid_data
from service.foundation.settings import Settings

ENDINGS = tuple(suffix for suffix, kind in SUFFIXES.items() if kind == "csv")
EXPECTED = f"a zip of files that end in {', '.join(ENDINGS)}"


def tables_of(names: Sequence[str]) -> list[str]:
    """The members of an archive that are joined, two and more, in its order; none where it holds anything else."""
    files = [name for name in names if not name.endswith("/") and not name.startswith("__MACOSX/")]
    return files if len(files) > 1 and all(name.lower().endswith(ENDINGS) for name in files) else []


@dataclass
class Part:
    """A member: its name, its table, and the places of its columns that are kept: a clock that was there is not."""

    name: str
    table: Table
    kept: list[int]


@contextmanager
def open_joined(path: Path, options: ReadOptions, settings: Settings) -> Iterator[Table]:
    """Open a zip of tables of text as one table; raise InvalidDataError naming the member, or TooLargeError.

    Columns come in the order of the members, in whose names files that have no column names are taken for a quantity of
    joints 1..n, or as `options.column_names` says, all columns of such files one after the other.
    """
    from service.datasets.formats.csv import open_csv  # noqa: PLC0415 - it imports pyarrow

    with TemporaryDirectory(dir=path.parent) as folder, ExitStack() as stack:
        with open_zip(path, EXPECTED) as archive:
            files = _unpacked(archive, Path(folder), settings)
        left = None if options.column_names is None else list(options.column_names)
        parts: list[Part] = []
        facts = [f"{len(files)} files are joined side by side: {', '.join(files)}"]
        known: set[str] = set()
        for name, file in files.items():
            try:
                table = stack.enter_context(open_csv(file, options, settings, Naming(name, left)))
            except ServiceError as error:
                raise within(name, error) from None
            repeated = known & {table.names[index] for clock in clocks(table.names) for index, _ in clock.parts}
            parts.append(Part(name, table, [i for i, each in enumerate(table.names) if each not in repeated]))
            known |= set(table.names)
        if left:
            raise invalid_data(
                "column_names", f"{len(left)} names too many", "one a column of the files that have no names"
            )
        names = checked_names([part.table.names[i] for part in parts for i in part.kept])
        units = {name: unit for part in parts for name, unit in part.table.units.items()}
        joined = Table(names, iter(()), units=units, facts=facts)
        joined.blocks = _side_by_side(parts, len(names), joined)
        yield joined


class Naming:
    """Names the columns of a member that has no names: those that are left of the options', or by its own name."""

    def __init__(self, member: str, left: list[str] | None) -> None:
        self.member, self.left = PurePosixPath(member), left

    def __call__(self, width: int) -> tuple[str, ...]:
        """Names of so many columns; raise InvalidDataError where there are none."""
        if self.left is not None:
            if len(self.left) < width:
                raise invalid_data("column_names", f"{len(self.left)} names that are left", f"{width}, one a column")
            taken, self.left[:] = self.left[:width], self.left[width:]
            return tuple(taken)
        stem = self.member.stem
        if width == 1 and clocks([stem]):
            return ("t",)
        parts = words(stem)
        subject = mention(parts)
        if subject is None:
            expected = (
                "column names in its first line, or a name that says what it holds, such as positions.txt; or "
                "column_names=t,q1..q7,tau1..tau7, all columns of such files in order"
            )
            raise invalid_data("header", "missing", expected)
        expressly = any(word.text in COMMANDED | MEASURED for word in parts)
        pattern = f"{stem}_" if expressly else subject.quantity
        return tuple(f"{pattern}{joint}" for joint in range(1, width + 1))


def _unpacked(archive: zipfile.ZipFile, folder: Path, settings: Settings) -> dict[str, Path]:
    """The tables of an archive by their names, under names of our own."""
    members = [archive.getinfo(name) for name in tables_of(archive.namelist())]
    if not members:
        raise invalid_data("file", "an archive of other files", EXPECTED)
    measure(members, settings)
    files = {}
    for index, member in enumerate(members):
        files[member.filename] = folder / f"{index}.txt"
        try:
            with archive.open(member) as source, files[member.filename].open("xb") as target:
                while piece := source.read(PIECE):
                    target.write(piece)
        except ERRORS as error:
            raise invalid_data(member.filename, first_line(error), "a member that can be unpacked") from None
    return files


def _side_by_side(parts: Sequence[Part], width: int, joined: Table) -> Iterator[Array]:
    """Blocks of all parts as one; raise InvalidDataError where they have not as many rows, or not the same times."""
    readers = [_Rows(part) for part in parts]
    row = 0
    while (count := min([block_rows(width), *(reader.waiting() for reader in readers)])) > 0:
        taken = [reader.take(count) for reader in readers]
        _check_times(parts, taken, row)
        row += count
        yield np.hstack([block[:, part.kept] for part, block in zip(parts, taken, strict=True)])
    for reader in readers:
        joined.facts += [f"{reader.part.name}: {fact}" for fact in reader.part.table.facts]
    totals = [row + reader.rest() for reader in readers]
    for part, total in zip(parts, totals, strict=True):
        if total != totals[0]:
            raise invalid_data(part.name, f"{total} rows", f"{totals[0]}, as {parts[0].name} has")


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
                raise invalid_data(where, f"{block[place, index]:.15g}", f"{known[1][place]:.15g}, as {known[0]} has")


class _Rows:
    """The rows of a part, as many at a time as are asked for."""

    def __init__(self, part: Part) -> None:
        self.part, self._block = part, np.empty((0, len(part.table.names)))

    def waiting(self) -> int:
        """Rows at hand; 0 at the end."""
        if len(self._block) == 0:
            try:
                self._block = next(self.part.table.blocks, self._block)
            except ServiceError as error:
                raise within(self.part.name, error) from None
        return len(self._block)

    def take(self, count: int) -> Array:
        """The next rows of those at hand."""
        taken, self._block = self._block[:count], self._block[count:]
        return taken

    def rest(self) -> int:
        """How many rows there are still."""
        count = 0
        while here := self.waiting():
            count += here
            self._block = self._block[:0]
        return count
