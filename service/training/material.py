"""What a job trains on: data sets, and for a refresh also what the model has observed."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
from sqlalchemy import select

import lipcore
from lipcore.samples import Array, Samples
from lipcore.urdf import RigidBody
from lipcore.vocabulary import TorqueConvention
from service.database import Database, DatasetRow, VersionRow
from service.files import Files
from service.models.lineage import named
from service.robots import store as robots
from service.settings import Settings
from service.training import holding_out
from service.training.holdout_schema import Holdout, HoldoutLineage
from service.updates.refreshing import material, scope
from service.updates.storage import log


class NothingToLearnError(ValueError):
    """No samples are left to train on."""


@dataclass(frozen=True)
class Material:
    """Samples and what is known of their robot.

    weights: (N,), how much each sample counts where the model forgets, else None; lineage: where the samples come from;
    seen: number of the newest event of the model's log when it was read; held_out: what the version is evaluated on and
    does not learn from, None where that is nothing.
    """

    samples: Samples
    torque_convention: TorqueConvention
    robot: RigidBody | None
    lineage: dict[str, Any]
    weights: Array | None = None
    seen: int = 0
    held_out: Samples | None = None


def recorded(database: Database, files: Files, request: dict[str, Any]) -> Material:
    """Samples of the data sets that a job names; raise CannotHoldOutError."""
    rows = _datasets(database, request["datasets"])
    tables = [files.read_samples(row.id, row.joint_names, row.sha256) for row in rows]
    asked = request.get("holdout")
    divided = holding_out.Divided(list(tables), None, None)
    if asked is not None:
        divided = holding_out.hold_out(rows, tables, Holdout.model_validate(asked))
    samples = Samples.concatenate([table for table in divided.train if table is not None])
    names, robot = rows[0].joint_names, request.get("robot")
    return Material(
        samples,
        rows[0].torque_convention,  # type: ignore[arg-type]  # checked when it was stored
        None if robot is None else robots.resolve(database, robot, names, request["joint_types"]),
        {"datasets": named(rows), **_holdout(divided.lineage)},
        held_out=divided.held_out,
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
        within = scope.find(session, model, refresh["through"])
        rows, left_out = scope.split(session, within, version.manifest["lineage"])
    rows = [row for row in rows if row.id in request["datasets"]]  # what may be deleted meanwhile was not promised
    base = lipcore.load(files.versions / version.folder, version.checksums)
    logged = material.read(
        database, model, base.joint_names, within, settings.max_refresh_samples, settings.max_time_gap_s
    )
    tables = [files.read_samples(row.id, row.joint_names, row.sha256) for row in rows]
    divided = holding_out.hold_out_again(rows, tables, version.manifest["lineage"])
    kept = [(row, part) for row, part in zip(rows, divided.train, strict=True) if part is not None]
    if not kept and logged.found < settings.min_samples:
        raise NothingToLearnError(f"the log has {logged.found} rows to train on, expected {settings.min_samples}")
    parts = [part for _, part in kept]
    times = [np.full(len(part), _uploaded(row)) for row, part in kept]
    log_lineage: dict[str, Any] = {"through": within.through, "rows": 0, "found": logged.found}
    if logged.samples is not None:
        parts.append(logged.samples)
        times.append(logged.samples.t)
        span = {"first": float(logged.samples.t.min()), "last": float(logged.samples.t.max())}
        log_lineage |= {"rows": len(logged.samples), **span}
    return Material(
        Samples.concatenate(parts),
        base.torque_convention,
        base.robot,
        {
            "datasets": named(rows),
            **_holdout(divided.lineage),
            "refresh": {**refresh, "left_out": left_out},
            "log": log_lineage,
        },
        material.weights(np.concatenate(times), within),
        seen,
        divided.held_out,
    )


def _datasets(database: Database, names: list[str]) -> list[DatasetRow]:
    with database.session() as session:
        found = {row.id: row for row in session.scalars(select(DatasetRow).where(DatasetRow.id.in_(names)))}
    return [found[name] for name in names]


def _holdout(lineage: HoldoutLineage | None) -> dict[str, Any]:
    return {} if lineage is None else {"holdout": lineage.model_dump(mode="json")}


def _uploaded(row: DatasetRow) -> float:
    return datetime.fromisoformat(row.created_at).timestamp()
