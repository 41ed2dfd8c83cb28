"""What a job trains on: data sets, and for a refresh also what the model has observed.

Rows of data sets count as one table, data set after data set, and are not in memory. What a fit chooses from is thinned
evenly over all of it, what a sum goes over is divided into shards, and whatever is read is read from the part of a file
where it lies.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any

import numpy as np

from lipcore.data import independence, outliers
from lipcore.data.outliers import Corrupt, CorruptError
from lipcore.data.samples import Array, Samples
from lipcore.data.splits import Mask, Numbers
from lipcore.kernels.geometry import Geometry
from lipcore.robots.urdf import RigidBody
from lipcore.training.conditioning import SHARD
from lipcore.vocabulary import TorqueConvention
from service.foundation.settings import Settings
from service.journal import log
from service.models.lineage import named
from service.models.schema import Holdout, HoldoutLineage
from service.robots import store as robots
from service.storage.database import Database, DatasetRow, VersionRow
from service.storage.files import Files
from service.storage.sample_file import ARRAYS, Reader
from service.training import holding_out, refresh_data
from service.training.holding_out import Clock, Divided

CANDIDATES = 20_000
"""Rows that a fit chooses from: of more, so many of them, thinned evenly."""
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
class Part:
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

    def clock(self) -> Clock:
        """Episodes and times of all rows, chosen or not."""
        return Clock(self.reader.array("episode"), self.reader.array("t"))

    def take(self, places: Numbers) -> Samples:
        """Those of the chosen rows, by their places among them; a new episode begins where rows in between are not."""
        index = places if self.chosen is None else np.flatnonzero(self.chosen)[places]
        values = self.reader.take(index)
        episode = values.pop("episode")
        begins = (np.diff(index) > 1) | (np.diff(episode) != 0)
        numbered = np.concatenate([np.zeros(min(1, len(index)), np.int64), np.cumsum(begins, dtype=np.int64)])
        return Samples(joint_names=tuple(self.row.joint_names), episode=numbered, **values)

    def independent_rows(self) -> float:
        """Independent samples that its rows count for."""
        if not self.timed:
            return self.factor * len(self)
        clock = self.clock()
        weights = independence.recording_weights(clock.t, clock.episode)
        return self.factor * float(weights.sum() if self.chosen is None else weights[self.chosen].sum())

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

    parts: list[Part]

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

    def shards(self) -> list[Shard]:
        """What its rows are summed up in."""
        return [shard for part in self.parts for shard in part.shards()]


def opened(files: Files, rows: Sequence[DatasetRow]) -> list[Part]:
    """Data sets as a whole; raise DamagedDataError."""
    return [Part(row, Reader(files.samples_file(row.id, row.sha256))) for row in rows]


def sound(part: Part) -> Corrupt:
    """The corrupt rows of a data set as a whole; raise CorruptError, naming it."""

    def take(first: int, last: int) -> Samples:
        values = {name: part.reader.array(name, first, last) for name in ARRAYS}
        return Samples(joint_names=tuple(part.row.joint_names), **values)

    try:
        return outliers.of_long(part.reader.rows, take)
    except CorruptError as error:
        raise CorruptError(f"{error.value}, of data set {part.row.id!r}", error.expected) from None


class NothingToLearnError(ValueError):
    """No samples are left to train on."""


@dataclass(frozen=True)
class Material:
    """Samples and what is known of their robot.

    samples: what a fit chooses from; stretches: contiguous samples, where these are thinned, else None; table: the data
    sets' rows to learn from; logged: what the model has observed, with weights (N,), None where that is nothing; rows:
    how many both are; lineage: where they come from; seen: number of the newest
    event of the model's log when it was read; held_out: samples that the version is evaluated on and does not learn
    from, and how many they stand for; None where that is nothing; geometries: of an arm, as an earlier version has
    learnt them.
    """

    samples: Samples
    stretches: Samples | None
    table: Table
    torque_convention: TorqueConvention
    robot: RigidBody | None
    lineage: dict[str, Any]
    logged: tuple[Samples, Array] | None = None
    seen: int = 0
    held_out: tuple[Samples, int] | None = None
    geometries: tuple[Geometry, ...] = ()

    @property
    def rows(self) -> int:
        """Samples that there are to learn from."""
        return len(self.table) + (0 if self.logged is None else len(self.logged[0]))


def recorded(settings: Settings, database: Database, files: Files, request: dict[str, Any]) -> Material:
    """Samples of the data sets that a job names; raise CannotHoldOutError."""
    with database.session() as session:
        known = refresh_data.datasets(session, request["datasets"])
    rows = [known[name] for name in request["datasets"]]
    parts = opened(files, rows)
    asked = request.get("holdout")
    divided = Divided([None] * len(parts), [None] * len(parts), None)
    if asked is not None:
        divided = holding_out.hold_out(rows, [part.clock() for part in parts], Holdout.model_validate(asked))
    found = [sound(part) for part in parts]
    table = _learnt(parts, divided, found)
    names, robot = rows[0].joint_names, request.get("robot")
    return Material(
        *_candidates(table, None),
        table,
        rows[0].torque_convention,  # type: ignore[arg-type]  # checked when it was stored
        None if robot is None else robots.resolve(database, robot, names, request["joint_types"]),
        {"datasets": named(rows), **_holdout(divided.lineage), **_corrupt(rows, found)},
        held_out=_held_out(settings, parts, divided, found),
    )


def observed(settings: Settings, database: Database, files: Files, model: str, request: dict[str, Any]) -> Material:
    """Samples that a refresh learns from; raise NothingToLearnError where there are too few.

    Data sets and rows of the log are chosen by what the log says now: a change that has been logged since the job was
    queued counts only if it lies within what the job learns from. What the version held out is held out again.
    """
    refresh = request["refresh"]
    with database.session() as session:
        version = session.get_one(VersionRow, (model, refresh["version"]))
        seen = log.newest(session, model)
        within = refresh_data.scope_of(session, model, refresh["through"])
        rows, left_out = refresh_data.split_datasets(session, within, version.manifest["lineage"])
    rows = [row for row in rows if row.id in request["datasets"]]  # what may be deleted meanwhile was not promised
    base = files.load_version(version.folder, version.checksums)
    logged = refresh_data.read_log(
        database, model, base.joint_names, within, settings.max_refresh_samples, settings.max_time_gap_s
    )
    parts = opened(files, rows)
    divided = holding_out.hold_out_again(rows, [part.clock() for part in parts], version.manifest["lineage"])
    found = [sound(part) for part in parts]
    table = _learnt([replace(part, factor=_aged(part.row, within)) for part in parts], divided, found)
    if not table.parts and logged.rows < settings.min_samples:
        raise NothingToLearnError(f"the log has {logged.rows} rows to train on, expected {settings.min_samples}")
    log_lineage: dict[str, Any] = {"through": within.through, "rows": 0, "found": logged.rows}
    weighted = None
    if (samples := logged.samples) is not None:
        span = {"first": float(samples.t.min()), "last": float(samples.t.max())}
        log_lineage |= {"rows": len(samples), **span}
        ages = refresh_data.age_weights(samples.t, within)
        counted = independence.recording_weights(samples.t, samples.episode)
        weighted = samples, counted if ages is None else counted * ages
    return Material(
        *_candidates(table, logged.samples),
        table,
        base.torque_convention,
        base.robot,
        {
            "datasets": named(rows),
            **_holdout(divided.lineage),
            **_corrupt(rows, found),
            "refresh": {**refresh, "left_out": left_out},
            "log": log_lineage,
        },
        weighted,
        seen,
        _held_out(settings, parts, divided, found),
        () if base.arm is None else (base.arm.geometry, *(each.geometry for each in base.arm.alternatives[1:])),
    )


def _learnt(parts: list[Part], divided: Divided, found: list[Corrupt]) -> Table:
    """What is learnt from of data sets, those left out that nothing is learnt from."""
    each = zip(parts, divided.train, found, strict=True)
    chosen = [replace(part, chosen=_without(mask, corrupt)) for part, mask, corrupt in each]
    return Table([part for part in chosen if len(part)])


def _held_out(
    settings: Settings, parts: list[Part], divided: Divided, found: list[Corrupt]
) -> tuple[Samples, int] | None:
    """What is evaluated on, thinned to as much as an evaluation takes, and how much there is of it."""
    each = zip(parts, divided.held_out, found, strict=True)
    table = Table([replace(part, chosen=_without(mask, corrupt)) for part, mask, corrupt in each if mask is not None])
    return (table.thinned(settings.max_evaluation_samples), len(table)) if len(table) else None


def _without(mask: Mask | None, corrupt: Corrupt) -> Mask | None:
    """Rows that are chosen and not corrupt, (N,); None for all."""
    if not corrupt.count:
        return mask
    return ~corrupt.rows if mask is None else mask & ~corrupt.rows


def _corrupt(rows: Sequence[DatasetRow], found: list[Corrupt]) -> dict[str, Any]:
    """What of each data set is left out as corrupt, learnt from or held out, for the lineage."""
    sets = [{"id": row.id, **each.report()} for row, each in zip(rows, found, strict=True) if each.count]
    return {"corrupt": sets} if sets else {}


def _candidates(table: Table, logged: Samples | None) -> tuple[Samples, Samples | None]:
    """What a fit chooses from, and contiguous samples where these are thinned."""
    log_rows = 0 if logged is None else len(logged)
    total = len(table) + log_rows
    many = total > CANDIDATES
    most = max(1, round(CANDIDATES * len(table) / total)) if many else total
    parts = [table.thinned(most)] if table.parts else []
    stretches = [table.stretches()] if table.parts else []
    if logged is not None:
        count = min(log_rows, max(1, round(CANDIDATES * log_rows / total))) if many else log_rows
        parts.append(logged.rows(np.linspace(0, log_rows - 1, count).round().astype(np.int64)))
        stretches.append(logged)
    return Samples.concatenate(parts), Samples.concatenate(stretches) if many else None


def _aged(row: DatasetRow, within: refresh_data.Scope) -> float:
    """What a data set's samples count where the model forgets: their age counts from their upload."""
    weights = refresh_data.age_weights(np.array([datetime.fromisoformat(row.created_at).timestamp()]), within)
    return 1.0 if weights is None else float(weights[0])


def _holdout(lineage: HoldoutLineage | None) -> dict[str, Any]:
    return {} if lineage is None else {"holdout": lineage.model_dump(mode="json")}
