"""Reading a file's table into columns in SI units on disk, in one pass."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lipcore.data.samples import Array
from lipcore.profiles import Profile
from lipcore.vocabulary import TorqueConvention
from service.datasets.formats.table import Table
from service.datasets.mapping import checks
from service.datasets.mapping.checks import ColumnStats, Rows, TimeChecker, TurnUnwrapper
from service.datasets.mapping.choice import MOTION
from service.datasets.mapping.joints import WARNING
from service.datasets.mapping.mapping import ColumnMap, Source, map_columns
from service.datasets.mapping.recognition import Rank, interpret_name
from service.datasets.options import UploadOptions
from service.datasets.staging import EPISODE, TIME, Staged, column
from service.foundation.errors import invalid_data
from service.foundation.settings import Settings
from service.foundation.text import counted
from service.storage.disk import Disk, DiskBudget


@dataclass(frozen=True)
class Recording:
    """The part of a `ReadResult` that is sent to another process; joint_names, lengths: of its columns."""

    joint_names: tuple[str, ...]
    lengths: dict[str, int]
    torque_convention: TorqueConvention
    facts: dict[str, Any]
    noted: list[str]


@dataclass(frozen=True)
class ReadResult:
    """A recording after reading."""

    staged: Staged
    torque_convention: TorqueConvention
    facts: dict[str, Any]
    """Figures for the report, JSON."""
    noted: list[str]
    """Sentences for the report on how columns were read and what was ignored."""


def read(
    table: Table,
    folder: Path,
    options: UploadOptions,
    robot: Profile | None,
    settings: Settings,
    disk: Disk | DiskBudget,
    min_samples: int = checks.MIN_SAMPLES,
) -> ReadResult:
    """Read a table's columns to files in a folder; raise InvalidDataError or StorageFullError.

    Every row of the file is kept; missing and infinite values become NaN. The preparation later removes rows with NaN
    and rows that repeat the time of the row before.
    """
    mapped = map_columns(table.names, table.units, table.joint_names, options, robot, settings.max_joints)
    first = next(table.blocks, None)
    without = {} if first is None or robot is not None else _without_effort(mapped, first)
    if without:
        fewer = replace(options, drop_joints=(*options.drop_joints, *without))
        mapped = map_columns(table.names, table.units, table.joint_names, fewer, robot, settings.max_joints)
    if options.read.poses:
        mapped = replace(
            mapped, t=(), episode=None, quantities={each: mapped.quantities[each] for each in ("q", "tau")}
        )
    reader = _Reader(mapped, Staged(folder, mapped.joints, disk), settings, min_samples, without)
    reader.commands = _commands(mapped, table.names)
    for block in chain([] if first is None else [first], table.blocks):
        reader.add(block)
    reader.finish()
    noted = [*table.facts, *mapped.notes, *reader.notes()]
    if options.read.poses:
        read_rows, poses = reader.staged.rows, reader.staged.average_poses()
        noted.append(f"{read_rows} rows are {poses} held poses: velocity and acceleration are zero")
    facts = {
        "effort": mapped.torque.effort,
        "columns": _columns(mapped, reader.staged),
        "units": {each.name: each.unit for row in mapped.quantities.values() for each in row if each.unit},
        "unused_columns": list(mapped.unused),
        "dropped_joints": list(mapped.dropped),
        "places": list(mapped.places),
        "torque_constants": None if mapped.torque.constants is None else list(mapped.torque.constants),
        "torque_factors": None if mapped.torque.factors is None else list(mapped.torque.factors),
        "rows_read": reader.rows,
        "turns": {name: each.count for name, each in zip(mapped.joints, reader.turns, strict=True) if each.count},
        "repeated_stamps": reader.times.repeated,
        "first_repeated_row": reader.times.first_repeated or None,
        "missing_rows": int(reader.staged.missing().sum()),
        "first_missing_row": reader.first_missing,
    }
    return ReadResult(reader.staged, mapped.torque.convention, facts, noted)


def _without_effort(mapped: ColumnMap, block: Array) -> dict[str, Source]:
    """Return the torque columns of joints, such as wheels, that have no value in a block, if others have some."""
    found = {
        joint: source
        for joint, source in zip(mapped.joints, mapped.quantities["tau"], strict=True)
        if not np.isfinite(block[:, source.index]).any()
    }
    return found if len(found) < len(mapped.joints) else {}


def _commands(mapped: ColumnMap, names: Sequence[str]) -> dict[str, tuple[int, int]]:
    """Return the pairs of a torque that is read and one that was commanded, by the name of the second."""
    return {
        name: (source.index, names.index(name))
        for name in mapped.unused
        for reading in interpret_name(name)[:1]
        if reading.quantity == "tau" and reading.rank == Rank.COMMANDED
        for label, source in zip(mapped.joints, mapped.quantities["tau"], strict=True)
        if reading.joint in {label, *(each.joint for each in interpret_name(source.name)[:1])}
    }


class _Reader:
    """Stages the blocks of a table and collects the statistics for the final checks."""

    def __init__(
        self,
        mapped: ColumnMap,
        staged: Staged,
        settings: Settings,
        min_samples: int,
        without: Mapping[str, Source],
    ) -> None:
        self.mapped, self.staged, self.settings, self.min_samples = mapped, staged, settings, min_samples
        self.without = without
        """Torque columns of joints that are left out because they have no effort."""
        self.rows = 0
        self.time = ColumnStats(mapped.t[0].name) if mapped.t else None
        self.time_has_unit = any(each.unit is not None for each in mapped.t)
        self.times = TimeChecker(mapped.t[0].name if mapped.t else TIME)
        self.stats = {quantity: [ColumnStats(each.name) for each in row] for quantity, row in mapped.quantities.items()}
        self.turns = [TurnUnwrapper() for _ in mapped.joints]
        self.left_out = {name: ColumnStats(each.name) for name, each in mapped.dropped.items()}
        self.commands: dict[str, tuple[int, int]] = {}
        """Torques that were commanded and equal those that are read, as far as known: see `_commands`."""
        self.absent = {quantity for quantity in MOTION if quantity in mapped.quantities}
        """Quantities without a value so far."""

    def add(self, block: Array) -> None:
        """Read a block (M, columns); raise InvalidDataError."""
        rows = np.arange(self.rows + 1, self.rows + len(block) + 1)
        self.rows += len(block)
        if self.rows > self.settings.max_samples:
            expected = f"at most {self.settings.max_samples}"
            raise invalid_data("rows", self.rows, expected, f"The file has too many rows, expected {expected}.")
        for name, (read, commanded) in list(self.commands.items()):
            if not np.array_equal(block[:, read], block[:, commanded], equal_nan=True):
                del self.commands[name]
        for joint, source in self.without.items():
            if (given := np.isfinite(block[:, source.index])).any():
                where, value = f"{source.name}, row {rows[given.argmax()]}", block[given.argmax(), source.index]
                expected = f"no value, as in the first rows. Leave out the joint with drop_joints={joint}"
                raise invalid_data(where, float(value), expected)
        episode = None
        if self.mapped.episode is not None:
            episode = np.ascontiguousarray(block[:, self.mapped.episode.index])
            checks.check_episodes(episode, rows, self.mapped.episode.name)
        t = self._time(block, rows)
        if t is not None:
            self.times.add(t, episode, rows)
        self._stage(block, rows, t, episode)

    def finish(self) -> None:
        """Check the whole recording; raise InvalidDataError."""
        for quantity in self.absent:
            del self.stats[quantity]
        missing = self.staged.missing()
        columns = [(joint, [row[j] for row in self.stats.values()]) for j, joint in enumerate(self.mapped.joints)]
        rows = len(missing), int(missing.sum()), self.times.repeated
        checks.check_rows(*rows, self.min_samples, self.time, columns)
        if self.mapped.t:
            checks.check_time_unit(self.staged.read(TIME), self.time_has_unit, self.mapped.t[0].name)
        joints = list(zip(self.mapped.joints, self.stats["q"], strict=True))
        has_unit = all(each.unit is not None for each in self.mapped.quantities["q"])
        checks.check_positions(joints, self.settings.max_position, has_unit)
        checks.check_torques(list(zip(self.mapped.joints, self.stats["tau"], strict=True)))
        self._check_slopes(missing)

    def notes(self) -> list[str]:
        """Return sentences on values that were changed or not used."""
        out = [f"{quantity} has no values and is ignored" for quantity in MOTION if quantity in self.absent]
        if self.commands:
            out.append(
                f"{WARNING}The torque equals what was commanded, {', '.join(self.commands)}, in all rows: it was not "
                "measured. If the robot has torque or current columns, read them with `columns`."
            )
        if self.without:
            out.append(f"joints without effort are left out: {', '.join(self.without)}")
        for name, turns in zip(self.mapped.joints, self.turns, strict=True):
            if turns.count:
                out.append(
                    f"the position of {name} jumps by whole turns {counted(turns.count, 'time')}, first in row "
                    f"{turns.first}; the jumps were removed"
                )
        for name, each in self.left_out.items():
            if each.span > checks.CHECKS.max_dropped_span:
                out.append(
                    f"{WARNING}{name} is left out although it moved by {each.span:.3g}. This affects the torques of "
                    "the other joints, unless it is of another arm on the same fixed base."
                )
            else:
                out.append(f"{name} is left out and did not move")
        return out

    @property
    def first_missing(self) -> int | None:
        """First row of the file with a missing value, counted from 1; None if there is none."""
        stats = [each for row in self.stats.values() for each in row] + ([self.time] if self.time else [])
        return min((each.first_missing for each in stats if each.missing), default=None)

    def _time(self, block: Array, rows: Rows) -> Array | None:
        if self.time is None:
            return None
        parts = [_scaled(block, each) for each in self.mapped.t]
        t = parts[0] if len(parts) == 1 else np.sum(parts, axis=0)
        if not self.time_has_unit:
            checks.check_epoch_unit(t, rows, self.time.name)
        self.time.add(t, rows)
        return t

    def _stage(self, block: Array, rows: Rows, t: Array | None, episode: Array | None) -> None:
        columns: dict[str, Array] = {}
        if t is not None:
            columns[TIME] = t
        if episode is not None:
            columns[EPISODE] = episode
        for quantity, row in self.mapped.quantities.items():
            values = [_scaled(block, each) for each in row]
            for each, stats in zip(values, self.stats[quantity], strict=True):
                stats.add(each, rows)
            if quantity in self.absent:
                if all(np.isnan(each).all() for each in values):
                    continue
                self._fill_before(quantity)
            if quantity == "q":
                values = [turns.unwrap(each, episode, rows) for turns, each in zip(self.turns, values, strict=True)]
            for joint, each in enumerate(values):
                columns[column(quantity, joint)] = each
        for name, source in self.mapped.dropped.items():
            self.left_out[name].add(_scaled(block, source), rows)
        self.staged.append(columns)

    def _fill_before(self, quantity: str) -> None:
        """Write NaN for a quantity in all rows before its first value."""
        self.absent.discard(quantity)
        if before := self.staged.rows:
            for joint in range(self.staged.n_joints):
                self.staged.append({column(quantity, joint): np.full(before, np.nan)})

    def _check_slopes(self, missing: NDArray[np.bool_]) -> None:
        """Raise InvalidDataError if velocities or accelerations do not match the slopes of their signals."""
        if not self.mapped.t or "dq" not in self.stats:
            return
        t = self.staged.read(TIME)
        episode = self.staged.read(EPISODE) if EPISODE in self.staged else None
        part = checks.find_slope_rows(t, episode, missing)
        for signal, derivative in (("q", "dq"), ("dq", "ddq")):
            if derivative in self.stats:
                ratios = [
                    checks.slope_ratio(
                        t[part],
                        self.staged.read(column(signal, joint))[part],
                        self.staged.read(column(derivative, joint))[part],
                    )
                    for joint in range(self.staged.n_joints)
                ]
                if (error := checks.find_unit_error(ratios, derivative)) is not None:
                    raise error


def _scaled(block: Array, source: Source) -> Array:
    """Return a column in SI units, NaN if not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        values: Array = block[:, source.index] * source.factor
    values[~np.isfinite(values)] = np.nan
    return values


def _columns(mapped: ColumnMap, staged: Staged) -> dict[str, list[str]]:
    """Return the names of the file's columns by quantity."""
    rows: dict[str, Sequence[Source]] = {
        TIME: mapped.t,
        EPISODE: [mapped.episode] if mapped.episode else [],
        **mapped.quantities,
    }
    return {
        name: [each.name for each in row]
        for name, row in rows.items()
        if row and (name in staged or name in staged.quantities)
    }
