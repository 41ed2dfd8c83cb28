"""What a job trains on: data sets, and for a refresh also what the model has observed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any

import numpy as np

from lipcore.data import independence, outliers
from lipcore.data.outliers import Corrupt, CorruptError
from lipcore.data.samples import Array, Samples
from lipcore.data.splits import Mask
from lipcore.kernels.arm_prior import Arm
from lipcore.kernels.geometry import Geometry
from lipcore.model.sibling import arm_as_expected, arm_of_sibling
from lipcore.online.gates import MAX_GAP_S
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import TorqueConvention
from service.contract.models import Holdout, HoldoutLineage
from service.datasets.mapping.checks import MIN_SAMPLES
from service.journal import log
from service.models import registry
from service.models.evaluation import MAX_EVALUATION_SAMPLES
from service.models.lineage import named
from service.robots import store as robots
from service.storage.database import Database, DatasetRow, VersionRow
from service.storage.files import Files
from service.storage.sample_file import ARRAYS
from service.training import holding_out, refresh_data
from service.training.holding_out import Divided
from service.training.refresh_data import Logged, Scope, Unlearnt
from service.training.repeating import unrepeated
from service.training.table import Table, TablePart, opened

MAX_REFRESH_SAMPLES = 200_000
"""Logged samples that a refresh learns from."""
CANDIDATES = 20_000
"""Rows that a fit chooses from: of more, so many of them, thinned evenly."""


def sound(part: TablePart) -> Corrupt:
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
    sets' rows to learn from; logged: what the model has observed, with weights (N,), None where that is nothing;
    logged_last: all of that, for the last fit; unlearnt: the newest of it, on which a refresh is compared before it
    learns it; rows: how many are learnt from; lineage: where they come from; seen: number of the newest
    event of the model's log when it was read; held_out: the data sets' rows that the version is judged on before it
    learns them; every: all their rows, for its last fit, None if there is none; geometries: of an arm, as an earlier
    version has learnt them; sibling: the arm of another unit, which is expected of this one.
    """

    samples: Samples
    stretches: Samples | None
    table: Table
    torque_convention: TorqueConvention
    robot: RigidBody | None
    lineage: dict[str, Any]
    logged: tuple[Samples, Array] | None = None
    logged_last: tuple[Samples, Array] | None = None
    unlearnt: Unlearnt | None = None
    seen: int = 0
    held_out: Table | None = None
    every: Table | None = None
    geometries: tuple[Geometry, ...] = ()
    sibling: Arm | None = None

    @property
    def rows(self) -> int:
        """Samples that there are to learn from."""
        return len(self.table) + (0 if self.logged is None else len(self.logged[0]))

    def for_last_fit(self) -> Material:
        """The same with all rows to learn from, those held out included."""
        assert self.every is not None  # there is a last fit
        logged = self.logged_last
        samples, stretches = _candidates(self.every, None if logged is None else logged[0])
        return replace(self, samples=samples, stretches=stretches, table=self.every, logged=logged, every=None)

    @property
    def learns_held_out(self) -> bool:
        """Whether the last fit learns what the data sets have held out."""
        return self.held_out is not None and self.every is not None and self.every is not self.table


def recorded(database: Database, files: Files, request: dict[str, Any]) -> Material:
    """Samples of the data sets that a job names; raise CannotHoldOutError."""
    with database.session() as session:
        known = refresh_data.datasets(session, request["datasets"])
    rows = [known[name] for name in request["datasets"]]
    parts = opened(files, rows)
    asked = request.get("holdout")
    divided = Divided([None] * len(parts), [None] * len(parts), None)
    if asked is not None:
        how, types = Holdout.model_validate(asked), request["joint_types"]
        clocks = [part.clock() for part in parts]
        divided = holding_out.hold_out(rows, clocks, how, lambda place: unrepeated(parts[place], types, how))
    corrupt = [sound(part) for part in parts]
    table, held_out, every = _tables(parts, divided, corrupt)
    names, robot = rows[0].joint_names, None
    if (asked_robot := request.get("robot")) is not None:
        robot = robots.resolve(database, asked_robot, names, request["joint_types"])
    sibling, base_lineage = None, {}
    if (base := request.get("base")) is not None:
        version = registry.named(database, base)
        unit = files.load_version(version.folder, version.checksums)
        robot, sibling = unit.robot, arm_of_sibling(unit)
        tensors = version.manifest["tensors"]["sha256"]
        base_lineage = {"base": {"model": version.model, "version": version.version, "sha256": tensors}}
    return Material(
        *_candidates(table, None),
        table,
        rows[0].torque_convention,  # type: ignore[arg-type]  # checked when it was stored
        robot,
        {"datasets": named(rows), **base_lineage, **_holdout(divided.lineage), **_corrupt(rows, corrupt)},
        held_out=held_out,
        every=every,
        sibling=sibling,
    )


def observed(database: Database, files: Files, model: str, request: dict[str, Any]) -> Material:
    """Samples that a refresh learns from; raise NothingToLearnError where there are too few.

    Data sets and rows of the log are chosen by what the log says now: a change that has been logged since the job was
    queued counts only if it lies within what the job learns from. What the version held out is held out again.
    """
    refresh = request["refresh"]
    with database.session() as session:
        version = session.get_one(VersionRow, (model, refresh["version"]))
        seen = log.newest(session, model)
        within = refresh_data.scope_of(session, model, refresh["through"])
        after = refresh_data.newest_part(session, model, within, log.start_of(session, model, version.version))
        rows, left_out = refresh_data.split_datasets(session, within, version.manifest["lineage"])
    rows = [row for row in rows if row.id in request["datasets"]]  # what may be deleted meanwhile was not promised
    base, lineage = files.load_version(version.folder, version.checksums), version.manifest["lineage"]

    def read(scope: Scope, most: int, above: int = 0) -> Logged:
        return refresh_data.read_log(database, model, base.joint_names, scope, most, MAX_GAP_S, above)

    logged = judged = read(within, MAX_REFRESH_SAMPLES)
    parts = opened(files, rows)
    divided = holding_out.hold_out_again(rows, [part.clock() for part in parts], version.manifest["lineage"])
    corrupt = [sound(part) for part in parts]
    parts = [replace(part, factor=_aged(part.row, within)) for part in parts]
    table, held_out, every = _tables(parts, divided, corrupt)
    if not table.parts and logged.rows < MIN_SAMPLES:
        raise NothingToLearnError(f"the log has {logged.rows} rows to train on, expected {MIN_SAMPLES}")
    newest, before = read(within, MAX_EVALUATION_SAMPLES, after), Logged(None, 0)
    unlearnt = None
    if newest.samples is not None:
        before = read(replace(within, through=after), MAX_REFRESH_SAMPLES)
        if len(table) + before.rows >= MIN_SAMPLES:
            unlearnt, judged = Unlearnt(after, newest.samples), before
            every = table if every is None else every
    log_lineage: dict[str, Any] = {"through": within.through, "rows": 0, "found": logged.rows}
    if (samples := logged.samples) is not None:
        span = {"first": float(samples.t.min()), "last": float(samples.t.max())}
        log_lineage |= {"rows": len(samples), **span}
    return Material(
        *_candidates(table, judged.samples),
        table,
        base.torque_convention,
        base.robot,
        {
            "datasets": named(rows),
            **({"base": lineage["base"]} if "base" in lineage else {}),
            **_holdout(divided.lineage),
            **_corrupt(rows, corrupt),
            "refresh": {**refresh, "left_out": left_out},
            "log": log_lineage,
        },
        _weighted(judged, within),
        _weighted(logged, within),
        unlearnt,
        seen,
        held_out,
        every,
        () if base.arm is None else base.arm.geometries,
        arm_as_expected(base.arm) if base.arm is not None and "base" in lineage else None,
    )


def _weighted(logged: Logged, within: Scope) -> tuple[Samples, Array] | None:
    """Samples of the log, and what each counts, (N,)."""
    if (samples := logged.samples) is None:
        return None
    ages = refresh_data.age_weights(samples.t, within)
    counted = independence.recording_weights(samples.t, samples.episode)
    return samples, counted if ages is None else counted * ages


def _tables(
    parts: list[TablePart], divided: Divided, corrupt: list[Corrupt]
) -> tuple[Table, Table | None, Table | None]:
    """The rows to learn from, those held out, and those of the last fit; None where that is nothing.

    Data sets of which nothing is left are not in a table.
    """
    held = _table(each for each in zip(parts, divided.held_out, corrupt, strict=True) if each[1] is not None)
    every = None
    if divided.lineage is not None and not divided.lineage.split.only:
        every = _table((part, None, found) for part, found in zip(parts, corrupt, strict=True))
    return _table(zip(parts, divided.train, corrupt, strict=True)), held if len(held) else None, every


def _table(chosen: Iterable[tuple[TablePart, Mask | None, Corrupt]]) -> Table:
    parts = [replace(part, chosen=_without(mask, corrupt)) for part, mask, corrupt in chosen]
    return Table([part for part in parts if len(part)])


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


def _aged(row: DatasetRow, within: Scope) -> float:
    """What a data set's samples count where the model forgets: their age counts from their upload."""
    weights = refresh_data.age_weights(np.array([datetime.fromisoformat(row.created_at).timestamp()]), within)
    return 1.0 if weights is None else float(weights[0])


def _holdout(lineage: HoldoutLineage | None) -> dict[str, Any]:
    """The split as a lineage keeps it; what is known only after the fit is left out."""
    return {} if lineage is None else {"holdout": lineage.model_dump(mode="json", exclude={"evaluations", "blocks"})}
