"""Refreshing the version that serves: asked for, or because motion, or its arm, has left what it can learn."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from sqlalchemy import Select, select
from sqlalchemy.orm import Session

from service.foundation.errors import BusyError, ConflictError
from service.foundation.settings import Settings
from service.foundation.states import ACTIVE
from service.journal import alarms
from service.journal.alarms import AlarmKind
from service.learning import learning
from service.learning.learner.messages import Published
from service.learning.refreshing.promotion import CANDIDATE
from service.models import registry
from service.storage.database import AlarmRow, Database, LearnerRow, ServingRow
from service.training import jobs, refreshes
from service.training.queue import JobQueue
from service.training.schema import Job

logger = logging.getLogger(__name__)

MOST_DOUBLINGS = 10


@dataclass(frozen=True)
class Reason:
    """Why a version is to be refreshed by itself, in words and in figures."""

    trigger: Literal["novelty", "linearisation"]
    text: str
    evidence: dict[str, Any]


def consider(settings: Settings, database: Database, queue: JobQueue, published: Published) -> Job | None:
    """Queue a refresh, with an alarm, where there is a reason for one; None where not.

    Not while learning is held, a refresh is under way or a candidate in contest, and not before a pause has passed
    since the last one, which doubles with every refresh of the same version. Where it is impossible, or its owner does
    not want it, an alarm says so once a version. Not for the event loop.
    """
    reasons = list(_reasons(settings, published))
    if not reasons:
        return None
    model = published.model
    with database.session() as session:
        if not _is_due(session, settings, published):
            return None
    version = registry.find(database, model, published.version)
    with database.transaction() as session:
        if not _is_due(session, settings, published):  # another thread may have been faster
            return None
        if not learning.options(session, model).auto_refresh:
            for each in reasons:
                _raise_once(session, model, each.trigger, f"{each.text}: a refresh would help", each.evidence)
            return None
        why = reasons[0]
        try:
            job = refreshes.add(session, settings, version, why.trigger)
        except ConflictError as error:
            text = f"{why.text}, but it cannot be refreshed: {error.message}"
            _raise_once(session, model, "refresh", text, why.evidence)
            return None
        except BusyError as error:
            logger.warning("model %s is to be refreshed, but %s", model, error.message)
            return None
        alarms.raise_alarm(session, model, why.trigger, f"{why.text}: it is refreshed", {**why.evidence, "job": job.id})
    queue.submit(job.id)
    return jobs.shown(job)


def _is_due(session: Session, settings: Settings, published: Published) -> bool:
    """Whether a refresh may be queued or an alarm be raised now."""
    model, version = published.model, published.version
    serving = session.get(ServingRow, model)
    if serving is None or serving.version != version or learning.held(session, model) is not None:
        return False
    before = list(session.scalars(refreshes.of(model)))
    if any(job.state in ACTIVE for job in before):
        return False
    contest = select(LearnerRow.version).where(LearnerRow.model == model, LearnerRow.role == CANDIDATE)
    if session.scalar(contest.limit(1)) is not None:
        return False
    if not learning.options(session, model).auto_promote and _is_better_known(session, model, version):
        return False
    ended = [_unix(job.finished_at or job.created_at) for job in before]
    earlier = sum(job.request["refresh"]["version"] == version for job in before)
    pause = settings.refresh_pause_s * 2 ** min(max(earlier - 1, 0), MOST_DOUBLINGS)
    return not ended or time.time() - max(ended) >= pause


def _is_better_known(session: Session, model: str, version: int) -> bool:
    """Whether the owner has been told of a version that predicts better, and has not let it answer."""
    told = _alarms(model, "promotion").where(
        AlarmRow.evidence["serving"].as_integer() == version, AlarmRow.evidence["verdict"].as_string() == "promote"
    )
    return session.scalar(told.limit(1)) is not None


def _raise_once(session: Session, model: str, kind: AlarmKind, message: str, evidence: dict[str, Any]) -> None:
    known = _alarms(model, kind).where(AlarmRow.evidence["version"].as_integer() == evidence["version"])
    if session.scalar(known.limit(1)) is None:
        alarms.raise_alarm(session, model, kind, message, evidence)


def _reasons(settings: Settings, published: Published) -> Iterator[Reason]:
    """What the revision shows that a refresh mends: motion beyond the basis, an arm that has left its linearisation."""
    named = f"version {published.version} of model {published.model!r}"
    revision = {"version": published.version, "revision": published.revision}
    share = published.novel_share
    if share > settings.novelty_share:
        text = f"{share:.0%} of the last {settings.novelty_rows} samples lie beyond what {named} can learn"
        figures: dict[str, Any] = {
            "novel_share": share,
            "threshold": settings.novelty_share,
            "rows": settings.novelty_rows,
            "novel_rows_since_start": published.novel_rows,
        }
        yield Reason("novelty", text, {**revision, **figures})
    errors = published.linearisation or (0.0,)
    if max(errors) > settings.linearisation_error:
        text = f"the arm of {named} has moved from where its torque is linear: {max(errors):.0%} of the stated error"
        by_joint = {"linearisation_error": list(errors), "threshold": settings.linearisation_error}
        yield Reason("linearisation", text, {**revision, **by_joint})


def _alarms(model: str, kind: AlarmKind) -> Select[int]:
    return select(AlarmRow.seq).where(AlarmRow.model == model, AlarmRow.kind == kind)


def _unix(moment: str) -> float:
    return datetime.fromisoformat(moment).timestamp()
