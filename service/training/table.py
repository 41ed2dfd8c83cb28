"""Rows of data sets as one table, data set after data set, which is not in memory: what a fit chooses from is thinned
evenly over all of it, what a sum goes over is divided into shards, and whatever is read is read from the part of a file
where it lies.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lipcore.data import independence
from lipcore.data.samples import Samples
from lipcore.data.splits import Mask, Numbers
from lipcore.training.conditioning import SHARD
from service.storage.database import DatasetRow
from service.storage.files import Files
from service.storage.sample_file import Reader
from service.training.holding_out import RowTimes

STRETCHES, STRETCH = 40, 500
"""Contiguous rows that tell the white noise of a recording that is thinned, and how many of these there are at most."""


@dataclass(frozen=True)
class Shard:
    """Rows `first` to `last`, exclusive, of a data set, in plain data. chosen: bits of those that count, all where
    None; timed: whether their times say how much they count; factor: what each counts besides."""

    dataset: str
    sha256: str
    first: int
    last: int
    chosen: bytes | None
    timed: bool
    factor: float

    def mask(self) -> Mask | None:
        """Which rows count, (last − first,); None for all."""
        if self.chosen is None:
            return None
        bits = np.unpackbits(np.frombuffer(self.chosen, np.uint8), count=self.last - self.first)
        return bits.astype(np.bool_)


@dataclass(frozen=True)
class TablePart:
    """What of one data set belongs to a table. chosen: (rows,), all where None; factor: what each row counts."""

    row: DatasetRow
    reader: Reader
    chosen: Mask | None = None
    factor: float = 1.0

    def __len__(self) -> int:
        return self.reader.rows if self.chosen is None else int(np.count_nonzero(self.chosen))

    @property
    def timed(self) -> bool:
        """Whether the times of its rows say how long each stands for."""
        return self.row.report.get("rate_hz") is not None

    def clock(self) -> RowTimes:
        """Episodes and times of all rows, chosen or not."""
        return RowTimes(self.reader.array("episode"), self.reader.array("t"))

    def take(self, places: Numbers) -> Samples:
        """Those of the chosen rows, by their places among them; a new episode begins where rows in between are not."""
        index = places if self.chosen is None else np.flatnonzero(self.chosen)[places]
        values = self.reader.take(index)
        episode = values.pop("episode")
        begins = (np.diff(index) > 1) | (np.diff(episode) != 0)
        numbered = np.concatenate([np.zeros(min(1, len(index)), np.int64), np.cumsum(begins, dtype=np.int64)])
        return Samples(joint_names=tuple(self.row.joint_names), episode=numbered, **values)

    def motion(self, most: int) -> tuple[Numbers, Samples]:
        """Of the chosen rows, in order of episode and time, at most so many, evenly, with the episodes of the
        recording; and their places in that order."""
        clock = self.clock()
        order = np.lexsort((clock.t, clock.episode))
        order = order if self.chosen is None else order[self.chosen[order]]
        places = np.linspace(0, len(order) - 1, min(len(order), most)).round().astype(np.int64)
        index, back = np.unique(order[places], return_inverse=True)
        values = {name: array[back] for name, array in self.reader.take(index).items()}
        return places, Samples(joint_names=tuple(self.row.joint_names), **values)

    def independent_rows(self) -> float:
        """Independent samples that its rows count for."""
        if not self.timed:
            return self.factor * len(self)
        clock = self.clock()
        weights = independence.recording_weights(clock.t, clock.episode)
        return self.factor * float(weights.sum() if self.chosen is None else weights[self.chosen].sum())

    def every(self, step: int) -> TablePart:
        """Every `step`-th of its rows, which counts for as many."""
        chosen = np.zeros(self.reader.rows, dtype=bool)
        chosen[(np.arange(self.reader.rows) if self.chosen is None else np.flatnonzero(self.chosen))[::step]] = True
        return replace(self, chosen=chosen, factor=step * self.factor)

    def shards(self) -> Iterator[Shard]:
        """Pieces of one size; those that nothing counts of are left out."""
        for first in range(0, self.reader.rows, SHARD):
            last = min(first + SHARD, self.reader.rows)
            mask = None if self.chosen is None else self.chosen[first:last]
            if mask is None or mask.any():
                bits = None if mask is None else np.packbits(mask).tobytes()
                yield Shard(self.row.id, self.row.sha256, first, last, bits, self.timed, self.factor)


@dataclass(frozen=True)
class Table:
    """Parts of data sets with the same joints, as one sequence of rows."""

    parts: list[TablePart]

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)

    def take(self, index: Numbers) -> Samples:
        """Chosen rows, at least one; index: rising."""
        parts, before = [], 0
        for part in self.parts:
            places = index[(index >= before) & (index < before + len(part))] - before
            before += len(part)
            if len(places):
                parts.append(part.take(places))
        return Samples.concatenate(parts)

    def thinned(self, most: int) -> Samples:
        """All rows, or of more than `most` so many, evenly."""
        return self.take(np.linspace(0, len(self) - 1, min(len(self), most)).round().astype(np.int64))

    def stretches(self) -> Samples:
        """Contiguous rows from all over the table."""
        begins = np.linspace(0, max(0, len(self) - STRETCH), STRETCHES).round().astype(np.int64)
        index = np.unique(begins[:, None] + np.arange(STRETCH))
        return self.take(index[index < len(self)])

    def independent_rows(self) -> float:
        """Independent samples that all rows count for."""
        return sum(part.independent_rows() for part in self.parts)

    def weighed(self, most: int) -> Table:
        """The table with what rows without times count: nobody knows how fast they were recorded, and so those of one
        data set count for no more than `most` independent ones."""
        bounded = [replace(part, factor=part.factor * min(1.0, most / len(part))) for part in self.parts]
        return Table([part if part.timed else less for part, less in zip(self.parts, bounded, strict=True)])

    def sparse(self, most: int) -> Table:
        """The table, or of more than `most` rows about so many, evenly, which count for all."""
        step = -(-len(self) // most)
        return self if step <= 1 else Table([part.every(step) for part in self.parts])

    def shards(self) -> list[Shard]:
        """What its rows are summed up in."""
        return [shard for part in self.parts for shard in part.shards()]


def opened(files: Files, rows: Sequence[DatasetRow]) -> list[TablePart]:
    """Data sets as a whole; raise DamagedDataError."""
    return [TablePart(row, Reader(files.samples_file(row.id, row.sha256))) for row in rows]
