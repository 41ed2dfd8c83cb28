"""Training data of a job: data sets and, for a refresh, the observations of the model."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any

import numpy as np

from lipcore.data import independence, outliers
from lipcore.data.motion import spaced_rows
from lipcore.data.outliers import CorruptRows, CorruptRowsError
from lipcore.data.samples import Array, Samples
from lipcore.data.splits import Mask
from lipcore.kernels.arm_prior import Arm
from lipcore.kernels.geometry import Geometry
from lipcore.model.sibling import arm_as_expected, arm_of_sibling
from lipcore.online.gates import MAX_GAP_S
from lipcore.robots.urdf import RigidBody
from lipcore.vocabulary import TorqueConvention
from service.contract.holdout import Holdout, HoldoutLineage
from service.datasets.mapping.checks import MIN_SAMPLES
from service.journal import log
from service.models import registry
from service.models.evaluation import MAX_EVALUATION_SAMPLES
from service.models.lineage import describe_datasets
from service.robots import store as robots
from service.storage.database import Database, DatasetRow, VersionRow
from service.storage.files import Files
from service.storage.sample_file import ARRAYS
from service.training import holding_out, refresh_data
from service.training.holding_out import DatasetSplits
from service.training.refresh_data import ComparisonRows, LoggedSamples, Scope
from service.training.repeating import unrepeated
from service.training.table import Table, TablePart, open_parts

MAX_REFRESH_SAMPLES = 200_000
"""Maximum logged samples that a refresh learns from."""
MAX_CANDIDATE_ROWS = 50_000
"""Maximum rows that a fit selects its samples from; more are thinned evenly."""


def find_corrupt_rows(part: TablePart) -> CorruptRows:
    """Return the corrupt rows of a whole data set; raise CorruptRowsError, naming the data set."""

    def take(first: int, last: int) -> Samples:
        values = {name: part.reader.array(name, first, last) for name in ARRAYS}
        return Samples(joint_names=tuple(part.row.joint_names), **values)

    try:
        return outliers.find_in_blocks(part.reader.rows, take)
    except CorruptRowsError as error:
        raise CorruptRowsError(f"{error.value}, of data set {part.row.id!r}", error.expected) from None


class NothingToLearnError(ValueError):
    """No samples are left to train on."""


@dataclass(frozen=True)
class TrainingData:
    """Samples of a training and what is recorded about their robot."""

    samples: Samples
    """Rows that the fit selects its samples from."""
    stretches: Samples | None
    """Contiguous samples if `samples` are thinned, else None."""
    table: Table
    """Rows of the data sets to learn from."""
    torque_convention: TorqueConvention
    robot: RigidBody | None
    lineage: dict[str, Any]
    """Origin of the data."""
    logged: tuple[Samples, Array] | None = None
    """Observations of the model to learn from, with weights (N,); None if there are none."""
    logged_last: tuple[Samples, Array] | None = None
    """The same for the last fit, `unlearnt` included."""
    unlearnt: ComparisonRows | None = None
    """Newest observations, on which a refresh is compared before its last fit learns them."""
    seen: int = 0
    """Number of the newest event of the model's log when it was read."""
    held_out: Table | None = None
    """Held-out rows of the data sets, on which the version is judged."""
    every: Table | None = None
    """All rows of the data sets, for the last fit; None if there is none."""
    geometries: tuple[Geometry, ...] = ()
    """Arm geometries that an earlier version has learnt."""
    sibling: Arm | None = None
    """Prior of the arm from another unit of the same robot."""

    @property
    def rows(self) -> int:
        """Number of rows to learn from."""
        return len(self.table) + (0 if self.logged is None else len(self.logged[0]))

    def for_last_fit(self) -> TrainingData:
        """Return a copy with all rows to learn from, held-out rows included."""
        assert self.every is not None  # there is a last fit
        logged = self.logged_last
        samples, stretches = _candidates(self.every, None if logged is None else logged[0])
        return replace(self, samples=samples, stretches=stretches, table=self.every, logged=logged, every=None)

    @property
    def learns_held_out(self) -> bool:
        """Whether the last fit learns the held-out rows of the data sets."""
        return self.held_out is not None and self.every is not None and self.every is not self.table


def load_datasets(database: Database, files: Files, request: dict[str, Any]) -> TrainingData:
    """Return the samples of a job's data sets; raise CannotHoldOutError."""
    with database.session() as session:
        known = refresh_data.datasets(session, request["datasets"])
    rows = [known[name] for name in request["datasets"]]
    parts = open_parts(files, rows, request["joint_types"])
    asked = request.get("holdout")
    splits = DatasetSplits([None] * len(parts), [None] * len(parts), None)
    if asked is not None:
        how, types = Holdout.model_validate(asked), request["joint_types"]
        clocks = [part.clock() for part in parts]
        splits = holding_out.hold_out(rows, clocks, how, lambda place: unrepeated(parts[place], types, how))
    corrupt = [find_corrupt_rows(part) for part in parts]
    table, held_out, every = _tables(parts, splits, corrupt)
    names, robot = rows[0].joint_names, None
    if (asked_robot := request.get("robot")) is not None:
        robot = robots.resolve(database, asked_robot, names, request["joint_types"])
    sibling, base_lineage = None, {}
    if (base := request.get("base")) is not None:
        version = registry.find_named(database, base)
        unit = files.load_version(version.folder, version.checksums)
        robot, sibling = unit.robot, arm_of_sibling(unit)
        tensors = version.manifest["tensors"]["sha256"]
        base_lineage = {"base": {"model": version.model, "version": version.version, "sha256": tensors}}
    return TrainingData(
        *_candidates(table, None),
        table,
        rows[0].torque_convention,  # type: ignore[arg-type]  # checked when it was stored
        robot,
        {"datasets": describe_datasets(rows), **base_lineage, **_holdout(splits.lineage), **_corrupt(rows, corrupt)},
        held_out=held_out,
        every=every,
        sibling=sibling,
    )


def load_refresh_data(database: Database, files: Files, model: str, request: dict[str, Any]) -> TrainingData:
    """Return the samples of a refresh; raise NothingToLearnError if there are too few.

    The current log decides which data sets and logged rows are used. A change of the robot logged after the job was
    queued counts only if it lies within the log range of the job. The split of the version's data sets is repeated.
    """
    refresh = request["refresh"]
    with database.session() as session:
        version = session.get_one(VersionRow, (model, refresh["version"]))
        seen = log.newest(session, model)
        within = refresh_data.scope_of(session, model, refresh["through"])
        after = refresh_data.newest_part(session, model, within, log.start_of(session, model, version.version))
        rows, left_out = refresh_data.split_datasets(session, within, version.manifest["lineage"])
    rows = [row for row in rows if row.id in request["datasets"]]  # others may be deleted meanwhile
    base, lineage = files.load_version(version.folder, version.checksums), version.manifest["lineage"]

    def read(scope: Scope, most: int, above: int = 0) -> LoggedSamples:
        return refresh_data.read_log(database, model, base.joint_names, scope, most, MAX_GAP_S, above)

    logged = judged = read(within, MAX_REFRESH_SAMPLES)
    parts = open_parts(files, rows, base.joint_types)
    splits = holding_out.hold_out_again(rows, [part.clock() for part in parts], version.manifest["lineage"])
    corrupt = [find_corrupt_rows(part) for part in parts]
    parts = [replace(part, factor=_aged(part.row, within)) for part in parts]
    table, held_out, every = _tables(parts, splits, corrupt)
    if not table.parts and logged.rows < MIN_SAMPLES:
        raise NothingToLearnError(f"the log has {logged.rows} rows to train on, expected at least {MIN_SAMPLES}")
    newest, before = read(within, MAX_EVALUATION_SAMPLES, after), LoggedSamples(None, 0)
    unlearnt = None
    if newest.samples is not None:
        before = read(replace(within, through=after), MAX_REFRESH_SAMPLES)
        if len(table) + before.rows >= MIN_SAMPLES:
            unlearnt, judged = ComparisonRows(after, newest.samples), before
            every = table if every is None else every
    log_lineage: dict[str, Any] = {"through": within.through, "rows": 0, "found": logged.rows}
    if (samples := logged.samples) is not None:
        span = {"first": float(samples.t.min()), "last": float(samples.t.max())}
        log_lineage |= {"rows": len(samples), **span}
    return TrainingData(
        *_candidates(table, judged.samples),
        table,
        base.torque_convention,
        base.robot,
        {
            "datasets": describe_datasets(rows),
            **({"base": lineage["base"]} if "base" in lineage else {}),
            **_holdout(splits.lineage),
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


def _weighted(logged: LoggedSamples, within: Scope) -> tuple[Samples, Array] | None:
    """Return logged samples with their weights, (N,)."""
    if (samples := logged.samples) is None:
        return None
    ages = refresh_data.age_weights(samples.t, within)
    counted = independence.recording_weights(samples.t, samples.episode)
    return samples, counted if ages is None else counted * ages


def _tables(
    parts: list[TablePart], splits: DatasetSplits, corrupt: list[CorruptRows]
) -> tuple[Table, Table | None, Table | None]:
    """Return the rows to learn from, the held-out rows and the rows of the last fit; None if there are none.

    Data sets without remaining rows are not in a table.
    """
    held = _table(each for each in zip(parts, splits.held_out, corrupt, strict=True) if each[1] is not None)
    every = None
    if splits.lineage is not None and not splits.lineage.split.only:
        every = _table((part, None, found) for part, found in zip(parts, corrupt, strict=True))
    return _table(zip(parts, splits.train, corrupt, strict=True)), held if len(held) else None, every


def _table(chosen: Iterable[tuple[TablePart, Mask | None, CorruptRows]]) -> Table:
    parts = [replace(part, chosen=_without(mask, corrupt)) for part, mask, corrupt in chosen]
    return Table([part for part in parts if len(part)])


def _without(mask: Mask | None, corrupt: CorruptRows) -> Mask | None:
    """Return the mask of selected rows that are not corrupt, (N,); None for all."""
    if not corrupt.count:
        return mask
    return ~corrupt.rows if mask is None else mask & ~corrupt.rows


def _corrupt(rows: Sequence[DatasetRow], found: list[CorruptRows]) -> dict[str, Any]:
    """Return the corrupt rows of each data set, which are neither learnt nor held out, for the lineage."""
    sets = [{"id": row.id, **each.report()} for row, each in zip(rows, found, strict=True) if each.count]
    return {"corrupt": sets} if sets else {}


def _candidates(table: Table, logged: Samples | None) -> tuple[Samples, Samples | None]:
    """Return the rows that a fit selects from, and contiguous samples if these are thinned."""
    log_rows = 0 if logged is None else len(logged)
    total = len(table) + log_rows
    many = total > MAX_CANDIDATE_ROWS
    most = max(1, round(MAX_CANDIDATE_ROWS * len(table) / total)) if many else total
    parts = [table.thinned(most)] if table.parts else []
    stretches = [table.stretches()] if table.parts else []
    if logged is not None:
        count = min(log_rows, max(1, round(MAX_CANDIDATE_ROWS * log_rows / total))) if many else log_rows
        parts.append(logged.rows(spaced_rows(log_rows, count)))
        stretches.append(logged)
    return Samples.concatenate(parts), Samples.concatenate(stretches) if many else None


def _aged(row: DatasetRow, within: Scope) -> float:
    """Return the weight of a data set's samples under forgetting; their age is the time since the upload."""
    weights = refresh_data.age_weights(np.array([datetime.fromisoformat(row.created_at).timestamp()]), within)
    return 1.0 if weights is None else float(weights[0])


def _holdout(lineage: HoldoutLineage | None) -> dict[str, Any]:
    """Return the split for a lineage, without the entries that need the fit."""
    later = {"evaluations", "blocks", "learning_curve"}
    return {} if lineage is None else {"holdout": lineage.model_dump(mode="json", exclude=later)}
