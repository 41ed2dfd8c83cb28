"""Models at a glance: what a page of robots shows, in one look at the database and at what is in memory."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from lipcore.online.window import Window
from service.contract.learning import Alarm
from service.contract.overview import (
    ArmSketch,
    CoursePoint,
    ModelOverview,
    OverviewPage,
    RecentQuality,
    SketchedJoint,
)
from service.learning.control import payload
from service.learning.ingest.monitor import Monitor
from service.learning.learners import Learners
from service.models import registry
from service.models.loaded import Served
from service.storage.database import AlarmRow, EventRow, LearningRow, ModelRow
from service.storage.rows import Page, newest
from service.training.promotion import CANDIDATE

HOUR_S = 3600.0
DECIMALS = 3
AWAY = 0.3
"""How far a posture lies within the training range, 0 to 1."""


def page(learners: Learners, part: Page) -> OverviewPage:
    """List models with what is known of each, newest first. No model is loaded for it. Not for the event loop."""
    now = time.time()
    with learners.database.session() as session:
        rows, following = newest(session, ModelRow, part)
        names = [row.name for row in rows]
        alarms, seen, held = _alarms(session, names), _seen(session, names), _held(session, names)
    serving = {name: each.version for name, each in registry.serving(learners.database, names).items()}
    pointers = registry.pointers(learners.database, names)
    with learners.database.session() as session:
        versions = registry.rows_of(session, [(row.name, serving.get(row.name, row.last_version)) for row in rows])
    monitors = learners.watched()
    items = []
    for row in rows:
        key = (row.name, serving.get(row.name, row.last_version))
        if (version := versions.get(key)) is None:  # deleted a moment ago
            continue
        manifest = version.manifest
        last = seen.get(row.name)
        items.append(
            ModelOverview(
                name=row.name,
                serving_version=serving.get(row.name),
                latest_version=row.last_version,
                estimator=manifest["estimator"],
                created_at=version.created_at,
                joint_names=manifest["joint_names"],
                joint_types=manifest["joint_types"],
                quality=registry.quality(manifest),
                candidate=pointers.get((row.name, CANDIDATE)),
                arm=sketch(manifest),
                position=_position(learners, row.name, manifest),
                idle_s=None if last is None else max(now - last, 0.0),
                held=row.name in held,
                failure=learners.status(*key).failure,
                alarm=alarms.get(row.name),
                **_watched(monitors.get(row.name), learners.loaded.peek(row.name), now),
            )
        )
    return OverviewPage(items=items, next_cursor=following)


def sketch(manifest: dict[str, Any]) -> ArmSketch | None:
    """The learnt arm of a version, None where its estimator knows none. Centres are first moment over mass."""
    parameters = manifest["parameters"]
    if "inertia" not in parameters:
        return None
    geometry, bodies = parameters["geometry"], parameters["inertia"]["bodies"]
    joints = []
    for joint, at in zip(geometry["order"], geometry["joints"], strict=True):
        body = bodies[joint]["plausible"]
        joints.append(
            SketchedJoint(
                joint=joint,
                mass=body["mass"],
                centre=[moment / body["mass"] for moment in body["first_moment"]],
                **{name: at[name] for name in ("type", "rotation", "translation", "axis")},
            )
        )
    return ArmSketch(gravity=geometry["gravity"], joints=joints)


def recent(window: Window, now: float) -> RecentQuality:
    """Figures of a window before a Unix time, s, and how they came about."""
    record = window.record(now)
    figures = record.metrics()
    return RecentQuality(
        seconds=window.seconds,
        rows=record.rows,
        nmse=figures["nmse"],
        coverage=figures["coverage"],
        course=[
            CoursePoint(at=at, rows=each.rows, innovation=np.round(np.sqrt(each.standardised), DECIMALS).tolist())
            for at, each in window.course(now)
            if each.rows
        ],
    )


def _watched(monitor: Monitor | None, served: Served | None, now: float) -> dict[str, Any]:
    """What only those know who have followed the model's rows."""
    if monitor is None:
        return {"recent": None, "payloads": None}
    window = min(monitor.windows, key=lambda each: abs(each.seconds - HOUR_S))
    return {
        "recent": recent(window, now),
        "payloads": None if served is None else payload.brief(monitor, served),
    }


def _position(learners: Learners, model: str, manifest: dict[str, Any]) -> list[float]:
    """Where the robot was when its last row came; where that is not known, a posture within the training range that is
    not stretched out, so that its links can be told apart."""
    last = learners.live.positions.get(model)
    if last is not None and len(last) == len(manifest["joint_names"]):
        return last
    span = manifest["training_range"]["q"]
    return [low + AWAY * (high - low) for low, high in zip(span["min"], span["max"], strict=True)]


def _alarms(session: Session, models: Sequence[str]) -> dict[str, Alarm]:
    """The newest alarm of each of these models."""
    last = select(func.max(AlarmRow.seq)).where(AlarmRow.model.in_(models)).group_by(AlarmRow.model)
    return {
        row.model: Alarm(id=row.seq, kind=row.kind, at=row.at, message=row.message, evidence=row.evidence)
        for row in session.scalars(select(AlarmRow).where(AlarmRow.seq.in_(last)))
    }


def _seen(session: Session, models: Sequence[str]) -> dict[str, float]:
    """When observations of each of these models came last, Unix time, s."""
    last = select(func.max(EventRow.received)).where(EventRow.model == ModelRow.name).scalar_subquery()  # by its index
    query = select(ModelRow.name, last).where(ModelRow.name.in_(models))
    return {model: at for model, at in session.execute(query) if at is not None}


def _held(session: Session, models: Sequence[str]) -> set[str]:
    """Those of these models whose learning waits for a decision."""
    query = select(LearningRow.model, LearningRow.held).where(LearningRow.model.in_(models))
    return {model for model, held in session.execute(query) if held is not None}
