"""Hold part of the data sets out of the judged fit, and find the same samples again from a lineage.

A refresh holds out what its version held out, if it still learns from that data set. The figures of both versions then
belong to judged fits on the same samples, which neither fit has learnt. Which version serves is decided on the newest
logged rows (`service.training.refreshed`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from lipcore.data.samples import Array
from lipcore.data.splits import GUARD_S, Kind, Mask, Numbers, Split, SplitError, SplitRows, choose_stretches, split
from service.contract.holdout import HeldOutSet, Holdout, HoldoutLineage
from service.foundation.errors import invalid_request
from service.foundation.fields import first_repeat
from service.storage.database import DatasetRow


class CannotHoldOutError(ValueError):
    """A data set cannot be split as requested."""

    code = "cannot_hold_out"


@dataclass(frozen=True)
class SetSplit:
    """How one data set is split into a learnt and a held-out part."""

    dataset: str
    asked: Holdout
    entire: bool
    """Whether the whole data set is held out."""
    guard: float
    """Gap between the two parts, in `unit`."""
    unit: Literal["s", "rows"]
    stretches: list[list[int]] | None = None
    """Rows to hold out, in order of episode and time; None if `asked` determines them."""
    known: tuple[int, int] | None = None
    """Numbers of held-out and guarded rows of an earlier split, which the new split must reproduce."""

    @property
    def rows(self) -> int:
        """Number of held-out rows of an earlier split."""
        assert self.known is not None
        return self.known[0]

    def parts(self, episode: Numbers, t: Array) -> SplitRows:
        """Split rows by their episodes and times, (N,) each.

        Raise CannotHoldOutError, also if the result differs from the earlier split.
        """
        if self.entire:
            parts = SplitRows(np.zeros(len(t), dtype=bool), np.ones(len(t), dtype=bool))
        else:
            match self.asked.kind:
                case "auto" | "stretches":
                    kind: Kind = "last"  # unused if `stretches` are given
                case kind:
                    pass
            how = Split(kind, self.asked.share, self.asked.blocks, self.guard, self.asked.seed)
            clock = t if self.unit == "s" else np.arange(len(t), dtype=np.float64)
            try:
                parts = split(episode, clock, how, self.stretches)
            except SplitError as error:
                raise CannotHoldOutError(f"data set {self.dataset!r}: {error}") from error
        counts = (int(np.count_nonzero(parts.held_out)), parts.guarded)
        if self.known is not None and counts != self.known:
            raise CannotHoldOutError(f"data set {self.dataset!r} cannot be split as before")
        return parts

    def held_out(self, episode: Numbers, t: Array) -> Mask:
        """Return the mask of held-out rows, see `parts`."""
        return self.parts(episode, t).held_out


class RowTimes(NamedTuple):
    """Episodes and times of a data set's rows, (N,) each."""

    episode: Numbers
    t: Array


@dataclass(frozen=True)
class DatasetSplits:
    """Masks over the rows of each data set, (N,): learnt and held-out rows."""

    train: list[Mask | None]
    """Rows of each data set that are used for training; None: all."""
    held_out: list[Mask | None]
    """Held-out rows of each data set; None means none."""
    lineage: HoldoutLineage | None
    """Record of the split; None if nothing is held out."""


def check(rows: Sequence[DatasetRow], asked: Holdout, min_samples: int) -> None:
    """Raise InvalidRequestError if the reports already show that the data sets cannot be split as requested."""
    _check_stretches(rows, asked)
    if (index := first_repeat(row.sha256 for row in rows)) is not None:
        message = f"Data set {rows[index].id} has the same samples as an earlier one of `datasets`."
        raise invalid_request(f"datasets[{index}]", rows[index].id, "samples of no earlier data set", message)
    for row in rows:
        if asked.guard_s is not None and not _is_timed(row):
            message = f"`holdout.guard_s` needs times, which data set {row.id} does not have."
            raise invalid_request("holdout.guard_s", asked.guard_s, "no guard without times", message)
    if asked.kind == "episodes" and len(rows) == 1 and rows[0].report["episodes"] < 2:
        raise invalid_request("holdout.kind", asked.kind, "last or blocks, as the data set has only one episode")
    total = sum(row.rows for row in rows)
    if asked.stretches is None:
        field, value, left = "holdout.share", asked.share, round((1 - asked.share) * total)
    else:
        named = sum(last - first for stretches in asked.stretches.values() for first, last in stretches)
        field, value, left = "holdout.stretches", named, total - named
    if left < min_samples:
        expected = f"less: it leaves {left} samples to train on, at least {min_samples} are needed"
        raise invalid_request(field, value, expected)


def _check_stretches(rows: Sequence[DatasetRow], asked: Holdout) -> None:
    """Raise InvalidRequestError unless stretches are disjoint ranges of rows of the data sets, in order."""
    if (asked.stretches is None) != (asked.kind != "stretches"):
        message = "`holdout.stretches` is required if `holdout.kind` is stretches, and not allowed otherwise."
        raise invalid_request("holdout.stretches", asked.stretches, "rows, only for kind stretches", message)
    known = {row.id: row.rows for row in rows}
    for name, stretches in (asked.stretches or {}).items():
        field = f"holdout.stretches.{name}"
        if name not in known:
            raise invalid_request(field, name, f"one of the data sets to train on: {', '.join(known)}")
        borders = [border for stretch in stretches for border in stretch]
        if any(a >= b for a, b in stretches) or borders != sorted(borders) or borders[-1] > known[name]:
            expected = f"ranges [first, last] in increasing order, with first < last and last at most {known[name]}"
            raise invalid_request(field, stretches, expected)


def hold_out(
    rows: Sequence[DatasetRow],
    clocks: Sequence[RowTimes],
    asked: Holdout,
    unrepeated: Callable[[int], list[list[int]] | None],
) -> DatasetSplits:
    """Split data sets for the first time; raise CannotHoldOutError.

    `unrepeated` returns the rows to hold out of the data set at an index if the kind is `auto`; None means its last
    part. Each data set is split on its own. If whole episodes are held out, a data set of one episode counts as an
    episode. The result for a data set does not depend on the order of the others.
    """
    single = {row.id for row, clock in zip(rows, clocks, strict=True) if len(np.unique(clock.episode)) < 2}
    if asked.kind != "episodes" or len(rows) == 1:
        single = set()
    entire = _entire([row for row in rows if row.id in single], asked) if len(single) > 1 else set()
    splits = {}
    for place, row in enumerate(rows):
        if asked.stretches is not None:
            if row.id in asked.stretches:
                splits[row.id] = _first(row, asked, False, asked.stretches[row.id])
        elif row.id in entire or row.id not in single:  # else its only episode is learnt
            splits[row.id] = _first(row, asked, row.id in entire, unrepeated(place) if asked.kind == "auto" else None)
    return _divide(rows, clocks, splits)


def hold_out_again(rows: Sequence[DatasetRow], clocks: Sequence[RowTimes], lineage: dict[str, Any]) -> DatasetSplits:
    """Split a version's data sets as its lineage records; raise CannotHoldOutError."""
    splits = {row.id: split for row in rows if (split := find_earlier_split(row, lineage)) is not None}
    return _divide(rows, clocks, splits)


def find_earlier_split(row: DatasetRow, lineage: dict[str, Any]) -> SetSplit | None:
    """Return how a version split a data set, or the same samples uploaded again; None if it held out nothing."""
    if (record := lineage.get("holdout")) is None:
        return None
    holdout = HoldoutLineage.model_validate(record)
    for each in sorted(holdout.datasets, key=lambda one: one.id != row.id):  # prefer the data set itself over a copy
        if row.id == each.id or row.sha256 == each.sha256:
            counts = (each.rows, each.guarded)
            return SetSplit(row.id, holdout.split, each.whole, each.guard, each.guard_unit, each.stretches, counts)
    return None


def _divide(rows: Sequence[DatasetRow], clocks: Sequence[RowTimes], splits: dict[str, SetSplit]) -> DatasetSplits:
    train: list[Mask | None] = []
    held: list[Mask | None] = []
    sets: list[HeldOutSet] = []
    for row, clock in zip(rows, clocks, strict=True):
        how = splits.get(row.id)
        if how is None:
            train.append(None)
            held.append(None)
            continue
        parts = how.parts(clock.episode, clock.t)
        train.append(parts.train)
        held.append(parts.held_out)
        sets.append(
            HeldOutSet(
                id=row.id,
                sha256=row.sha256,
                whole=how.entire,
                guard=how.guard,
                guard_unit=how.unit,
                rows=int(np.count_nonzero(parts.held_out)),
                guarded=parts.guarded,
                stretches=how.stretches,
            )
        )
    if not sets:
        return DatasetSplits(train, held, None)
    asked = next(iter(splits.values())).asked
    total = {name: sum(getattr(each, name) for each in sets) for name in ("rows", "guarded")}
    return DatasetSplits(train, held, HoldoutLineage(split=asked, datasets=sets, **total))


def _first(row: DatasetRow, asked: Holdout, entire: bool, stretches: list[list[int]] | None) -> SetSplit:
    """Return the first split of a data set."""
    if not _is_timed(row):
        return SetSplit(row.id, asked, entire, 25.0, "rows", stretches)  # a guard of 25 rows, as the rate is unknown
    guard = asked.guard_s
    if guard is None:  # one period of the low-pass filter of the preparation, if there was one
        cutoff = row.report["recipe"]["cutoff_hz"]
        guard = GUARD_S if cutoff is None else 1.0 / float(cutoff)
    return SetSplit(row.id, asked, entire, guard, "s", stretches)


def _entire(rows: Sequence[DatasetRow], asked: Holdout) -> set[str]:
    """Return the ids of the single-episode data sets that are held out as a whole."""
    ordered = sorted(rows, key=lambda row: row.sha256)
    chosen = choose_stretches(np.array([row.rows for row in ordered]), asked.share, asked.seed)
    return {row.id for row, held in zip(ordered, chosen, strict=True) if held}


def _is_timed(row: DatasetRow) -> bool:
    return row.report.get("rate_hz") is not None
