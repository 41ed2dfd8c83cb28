"""Refreshing the version that serves because motion, or its arm, has left what it can learn."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session

from lipcore.data.metrics import BLOCK_S, MIN_BLOCKS
from service.contract.jobs import Job
from service.contract.learning import AlarmKind
from service.contract.states import ACTIVE
from service.foundation.errors import BusyError, ConflictError
from service.foundation.text import percent
from service.journal import log
from service.journal.alarms import raise_alarm
from service.learning import owner
from service.learning.learner.follower import NOVELTY_ROWS
from service.learning.learner.publication import Published
from service.learning.learners import Learners
from service.models import registry
from service.storage.database import AlarmRow, Database, EventRow, ServingRow
from service.training import jobs
from service.training.queue import JobQueue
from service.training.refresh_data import COMPARED

logger = logging.getLogger(__name__)

MOST_DOUBLINGS = 10
LEAST_S = MIN_BLOCKS * BLOCK_S / COMPARED
"""Seconds of observations after which a version may be refreshed by itself: enough to compare both on COMPARED."""


@dataclass(frozen=True)
class RefreshRule:
    """When a version is refreshed by itself.

    novelty_share: share of the last NOVELTY_ROWS rows beyond the basis. linearisation_error: error of a learnt arm's
    linearisation; 1: as large as stated. pause_s: shortest time between two refreshes.
    """

    novelty_share: float = 0.2
    linearisation_error: float = 0.5
    pause_s: float = 600.0


RULE = RefreshRule()


def attach(learners: Learners, queue: JobQueue) -> None:
    """Let versions be refreshed by themselves; once, before the first observation is taken."""

    def published(message: Published) -> None:
        consider(learners.database, queue, message)

    learners.when_published.append(published)


@dataclass(frozen=True)
class Reason:
    """Why a version is to be refreshed by itself, in words and in figures."""

    trigger: Literal["novelty", "linearisation"]
    text: str
    evidence: dict[str, Any]


def consider(database: Database, queue: JobQueue, published: Published) -> Job | None:
    """Queue a refresh, with an alarm, where there is a reason for one; None where not.

    Not while learning is held or a refresh is under way, and not before a pause has passed since the last one, which
    doubles with every refresh of the same version. Where it is impossible, or its owner does not want it, an alarm says
    so once a version. Not for the event loop.
    """
    reasons = list(_reasons(published))
    if not reasons:
        return None
    model = published.model
    with database.session() as session:
        if not _is_due(session, published):
            return None
    version = registry.find(database, model, published.version)
    with database.transaction() as session:
        if not _is_due(session, published):  # another thread may have been faster
            return None
        if not owner.options(session, model).auto_refresh:
            for each in reasons:
                _raise_once(session, model, each.trigger, f"{each.text}: a refresh would help", each.evidence)
            return None
        why = reasons[0]
        try:
            job = jobs.add_refresh(session, version, why.trigger)
        except ConflictError as error:
            text = f"{why.text}, but it cannot be refreshed: {error.message}"
            _raise_once(session, model, "refresh", text, why.evidence)
            return None
        except BusyError as error:
            logger.warning("model %s is to be refreshed, but %s", model, error.message)
            return None
        raise_alarm(session, model, why.trigger, f"{why.text}: it is refreshed", {**why.evidence, "job": job.id})
    queue.submit(job.id)
    return jobs.represent(job)


def _is_due(session: Session, published: Published) -> bool:
    """Whether a refresh may be queued or an alarm be raised now."""
    model, version = published.model, published.version
    serving = session.get(ServingRow, model)
    if serving is None or serving.version != version or owner.held(session, model) is not None:
        return False
    before = list(session.scalars(jobs.refreshes_of(model)))
    if any(job.state in ACTIVE for job in before):
        return False
    if _observed_s(session, model, version) < LEAST_S:
        return False
    if not owner.options(session, model).auto_promote and _is_better_known(session, model, version):
        return False
    ended = [datetime.fromisoformat(job.finished_at or job.created_at).timestamp() for job in before]
    earlier = sum(job.request["refresh"]["version"] == version for job in before)
    pause = RULE.pause_s * 2 ** min(max(earlier - 1, 0), MOST_DOUBLINGS)
    return not ended or time.time() - max(ended) >= pause


def _observed_s(session: Session, model: str, version: int) -> float:
    """Seconds of the rows that a version has learnt while serving, batch by batch."""
    start = log.start_of(session, model, version)
    learnt = (EventRow.model == model, EventRow.number > start, EventRow.learnt > 0, EventRow.void.is_(False))
    return session.scalar(select(func.sum(EventRow.last - EventRow.first)).where(*learnt)) or 0.0


def _is_better_known(session: Session, model: str, version: int) -> bool:
    """Whether an alarm has named a version that predicts better, and the owner has not let it answer."""
    alarms = _alarms(model, "promotion").where(
        AlarmRow.evidence["serving"].as_integer() == version, AlarmRow.evidence["verdict"].as_string() == "promote"
    )
    return session.scalar(alarms.limit(1)) is not None


def _raise_once(session: Session, model: str, kind: AlarmKind, message: str, evidence: dict[str, Any]) -> None:
    known = _alarms(model, kind).where(AlarmRow.evidence["version"].as_integer() == evidence["version"])
    if session.scalar(known.limit(1)) is None:
        raise_alarm(session, model, kind, message, evidence)


def _reasons(published: Published) -> Iterator[Reason]:
    """What the revision shows that a refresh mends: motion beyond the basis, an arm that has left its linearisation."""
    named = f"version {published.version} of model {published.model!r}"
    revision = {"version": published.version, "revision": published.revision}
    share = published.novel_share
    if share > RULE.novelty_share:
        text = f"{percent(share)} of the last {NOVELTY_ROWS} samples lie beyond what {named} can learn"
        figures: dict[str, Any] = {
            "novel_share": share,
            "threshold": RULE.novelty_share,
            "rows": NOVELTY_ROWS,
            "novel_rows_since_start": published.novel_rows,
        }
        yield Reason("novelty", text, {**revision, **figures})
    errors = published.linearisation or (0.0,)
    if max(errors) > RULE.linearisation_error:
        text = (
            f"the arm of {named} has moved from where its torque is linear: {percent(max(errors))} of the stated error"
        )
        by_joint = {"linearisation_error": list(errors), "threshold": RULE.linearisation_error}
        yield Reason("linearisation", text, {**revision, **by_joint})


def _alarms(model: str, kind: AlarmKind) -> Select[int]:
    return select(AlarmRow.seq).where(AlarmRow.model == model, AlarmRow.kind == kind)
