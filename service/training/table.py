"""Rows of data sets as one table that stays on disk, one data set after another.

A fit reads rows thinned evenly over the table; a sum reads it in shards. Only the needed part of a file is read.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lipcore.data import independence
from lipcore.data.motion import spaced_rows
from lipcore.data.samples import Array, Samples
from lipcore.data.splits import Mask, Numbers
from lipcore.training.conditioning import SHARD
from lipcore.vocabulary import JointType
from service.storage.database import DatasetRow
from service.storage.files import Files
from service.storage.sample_file import Reader, follow
from service.training.holding_out import RowTimes

STRETCHES, STRETCH = 40, 500
"""Maximum number of contiguous segments that estimate the white noise of a thinned recording, and rows of each."""


@dataclass(frozen=True)
class Shard:
    """Rows `first` to `last` (exclusive) of a data set, as plain data."""

    dataset: str
    sha256: str
    first: int
    last: int
    chosen: bytes | None
    """Bits of the selected rows; None means all."""
    timed: bool
    """Whether the rows are weighted by their times."""
    factor: float
    """Additional weight of each row."""

    def mask(self) -> Mask | None:
        """Return the mask of selected rows, (last − first,); None for all."""
        if self.chosen is None:
            return None
        bits = np.unpackbits(np.frombuffer(self.chosen, np.uint8), count=self.last - self.first)
        return bits.astype(np.bool_)


@dataclass(frozen=True)
class TablePart:
    """The rows of one data set that belong to a table."""

    row: DatasetRow
    reader: Reader
    chosen: Mask | None = None
    """Mask of the selected rows, (rows,); None means all."""
    factor: float = 1.0
    """Weight of each row."""
    joint_types: tuple[JointType, ...] | None = None
    """Types of the joints, to include deflections in samples; None for none."""

    def __len__(self) -> int:
        return self.reader.rows if self.chosen is None else int(np.count_nonzero(self.chosen))

    @property
    def timed(self) -> bool:
        """Whether its rows have times, which determine their weights."""
        return self.row.report.get("rate_hz") is not None

    def clock(self) -> RowTimes:
        """Return episodes and times of all rows, selected or not."""
        return RowTimes(self.reader.array("episode"), self.reader.array("t"))

    def take(self, places: Numbers) -> Samples:
        """Return selected rows by their indices among the selected ones; a gap between rows starts a new episode."""
        index = places if self.chosen is None else np.flatnonzero(self.chosen)[places]
        values = self.reader.take(index)
        episode = values.pop("episode")
        begins = (np.diff(index) > 1) | (np.diff(episode) != 0)
        numbered = np.concatenate([np.zeros(min(1, len(index)), np.int64), np.cumsum(begins, dtype=np.int64)])
        return Samples(
            joint_names=tuple(self.row.joint_names), episode=numbered, deflections=self._deflections(index), **values
        )

    def motion(self, most: int) -> tuple[Numbers, Samples]:
        """Return at most `most` selected rows in order of episode and time, and their indices in that order.

        They are thinned evenly; episodes are those of the recording.
        """
        clock = self.clock()
        order = np.lexsort((clock.t, clock.episode))
        order = order if self.chosen is None else order[self.chosen[order]]
        places = spaced_rows(len(order), most)
        index, back = np.unique(order[places], return_inverse=True)
        values = {name: array[back] for name, array in self.reader.take(index).items()}
        deflections = self._deflections(index)
        if deflections is not None:
            values["deflections"] = deflections[back]
        return places, Samples(joint_names=tuple(self.row.joint_names), **values)

    def _deflections(self, index: Numbers) -> Array | None:
        return None if self.joint_types is None else follow(self.reader, index, self.joint_types)

    def independent_rows(self) -> float:
        """Return the number of effective samples of its rows."""
        if not self.timed:
            return self.factor * len(self)
        clock = self.clock()
        weights = independence.recording_weights(clock.t, clock.episode)
        return self.factor * float(weights.sum() if self.chosen is None else weights[self.chosen].sum())

    def every(self, step: int) -> TablePart:
        """Return every `step`-th row, with the weight of `step` rows."""
        chosen = np.zeros(self.reader.rows, dtype=bool)
        chosen[(np.arange(self.reader.rows) if self.chosen is None else np.flatnonzero(self.chosen))[::step]] = True
        return replace(self, chosen=chosen, factor=step * self.factor)

    def shards(self) -> Iterator[Shard]:
        """Yield shards of equal size; skip those without selected rows."""
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
        """Return rows by rising indices, at least one."""
        parts, before = [], 0
        for part in self.parts:
            places = index[(index >= before) & (index < before + len(part))] - before
            before += len(part)
            if len(places):
                parts.append(part.take(places))
        return Samples.concatenate(parts)

    def thinned(self, most: int) -> Samples:
        """Return all rows, thinned evenly to at most `most`."""
        return self.take(spaced_rows(len(self), most))

    def stretches(self) -> Samples:
        """Return contiguous rows from all over the table."""
        begins = np.linspace(0, max(0, len(self) - STRETCH), STRETCHES).round().astype(np.int64)
        index = np.unique(begins[:, None] + np.arange(STRETCH))
        return self.take(index[index < len(self)])

    def independent_rows(self) -> float:
        """Return the number of effective samples of all rows."""
        return sum(part.independent_rows() for part in self.parts)

    def weighed(self, most: int) -> Table:
        """Return the table with lower weights for rows without times.

        Their sampling rate is unknown, so the rows of one data set weigh no more than `most` independent ones.
        """
        bounded = [replace(part, factor=part.factor * min(1.0, most / len(part))) for part in self.parts]
        return Table([part if part.timed else less for part, less in zip(self.parts, bounded, strict=True)])

    def sparse(self, most: int) -> Table:
        """Return about `most` rows, thinned evenly, with the weight of all rows."""
        step = -(-len(self) // most)
        return self if step <= 1 else Table([part.every(step) for part in self.parts])

    def shards(self) -> list[Shard]:
        """Return the shards of all parts."""
        return [shard for part in self.parts for shard in part.shards()]


def open_parts(
    files: Files, rows: Sequence[DatasetRow], joint_types: Sequence[JointType] | None = None
) -> list[TablePart]:
    """Return whole data sets as table parts; raise DamagedDataError. joint_types: see `TablePart`."""
    types = None if joint_types is None else tuple(joint_types)
    readers = [Reader(files.samples_file(row.id, row.sha256)) for row in rows]
    return [TablePart(row, reader, joint_types=types) for row, reader in zip(rows, readers, strict=True)]
