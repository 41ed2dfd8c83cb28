"""The alarm that the friction learnt by the serving version is negative, and its end."""

from __future__ import annotations

from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from lipcore.model.parameters import FrictionName, NegativeFriction
from service.journal.alarms import raise_alarm
from service.learning import texts
from service.learning.learner.publication import Publication
from service.learning.learners import Learners
from service.models import registry
from service.storage.database import AlarmRow, Database, ServingRow

MAX_DEVIATIONS, END_DEVIATIONS = 2.0, 1.0
"""Standard deviations below zero at which a coefficient raises the alarm, and at which the alarm ends."""
UNITS: dict[FrictionName, tuple[str, str]] = {
    "viscous": (" N·m·s/rad", " N·s/m"),
    "coulomb": (" N·m", " N"),
    "load": ("", ""),
}
"""Units of the coefficients of revolute and of prismatic joints."""


def attach(learners: Learners) -> None:
    """Raise the alarm automatically from now on. Call it once, before the first observation."""
    learners.on_published.append(lambda message: report_friction(learners.database, message))


def report_friction(database: Database, published: Publication) -> None:
    """Raise the alarm if a coefficient has become negative beyond doubt, and report its end once none is any more.

    Blocking: use it in a thread.
    """
    with database.session() as session:
        if _evidence(session, published) is None:
            return
    joints = registry.find(database, published.model, published.version).manifest
    with database.transaction() as session:
        evidence = _evidence(session, published)
        if evidence is None:  # another service has reported it
            return
        described = [
            texts.describe_coefficient(
                joints["joint_names"][each.joint],
                each.name,
                each.mean,
                each.std,
                UNITS[each.name][joints["joint_types"][each.joint] == "prismatic"],
            )
            for each in _implausible(published, MAX_DEVIATIONS)
        ]
        text = texts.describe_friction(described) if evidence["coefficients"] else texts.describe_plausible_friction()
        raise_alarm(session, published.model, "friction", text, evidence, clears=not evidence["coefficients"])


def _implausible(published: Publication, deviations: float) -> list[NegativeFriction]:
    return [each for each in published.negative_friction if each.is_implausible(deviations)]


def _evidence(session: Session, published: Publication) -> dict[str, Any] | None:
    """Return the evidence of the alarm, or of its end, that a publication gives reason for; None without one."""
    model, version = published.model, published.version
    serving = session.get(ServingRow, model)
    if serving is None or serving.version != version:
        return None
    of_version = (
        AlarmRow.model == model,
        AlarmRow.kind == "friction",
        AlarmRow.evidence["version"].as_integer() == version,
    )
    last = session.scalar(select(AlarmRow).where(*of_version).order_by(AlarmRow.seq.desc()).limit(1))
    known = [] if last is None else last.evidence["coefficients"]
    if last is not None and last.evidence["revision"] >= published.revision:  # of a service that is ahead
        return None
    negative = _implausible(published, MAX_DEVIATIONS)
    listed = {(each["joint"], each["name"]) for each in known}
    is_new = any((each.joint, each.name) not in listed for each in negative)
    still = {(each.joint, each.name) for each in _implausible(published, END_DEVIATIONS)}
    if not is_new and (not listed or listed & still):
        return None
    figures = [{"joint": each.joint, "name": each.name, "mean": each.mean, "std": each.std} for each in negative]
    return {"version": version, "revision": published.revision, "coefficients": figures}
