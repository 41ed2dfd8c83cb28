"""The automatic refresh of the serving version if motion leaves its basis, or its arm the linearisation."""

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
from service.journal import log
from service.journal.alarms import raise_alarm
from service.learning import owner, texts
from service.learning.learner.follower import NOVELTY_ROWS
from service.learning.learner.publication import Publication
from service.learning.learners import Learners
from service.models import registry
from service.storage.database import AlarmRow, Database, EventRow, ServingRow
from service.training import jobs
from service.training.queue import JobQueue
from service.training.refresh_data import COMPARED_SHARE

logger = logging.getLogger(__name__)

MAX_DOUBLINGS = 10
"""Max doublings of the pause between two refreshes of the same version."""
MIN_OBSERVED_S = MIN_BLOCKS * BLOCK_S / COMPARED_SHARE
"""Seconds of observations before a version may be refreshed: enough to compare both on `COMPARED_SHARE` of them."""


@dataclass(frozen=True)
class RefreshRule:
    """The limits that trigger an automatic refresh, and the pause between two."""

    novelty_share: float = 0.2
    """Share of the last `NOVELTY_ROWS` rows that the model's basis does not represent."""
    linearisation_error: float = 0.5
    """Linearisation error of a learnt arm, divided by the stated error."""
    pause_s: float = 600.0
    """Min seconds between two refreshes."""


RULE = RefreshRule()


def attach(learners: Learners, queue: JobQueue) -> None:
    """Refresh versions automatically from now on. Call it once, before the first observation."""

    def published(message: Publication) -> None:
        queue_refresh(learners.database, queue, message)

    learners.on_published.append(published)


@dataclass(frozen=True)
class RefreshReason:
    """Why a version is to be refreshed, as text and as evidence."""

    trigger: Literal["novelty", "linearisation"]
    text: str
    evidence: dict[str, Any]


def queue_refresh(database: Database, queue: JobQueue, published: Publication) -> Job | None:
    """Queue a refresh and raise an alarm if there is a reason for one; else return None.

    Nothing is queued while learning is paused or a refresh runs. A pause must have passed since the last refresh; it
    doubles with every refresh of the same version. If a refresh is impossible or switched off, an alarm reports that
    once a version. Blocking: use it in a thread.
    """
    reasons = list(_find_reasons(published))
    if not reasons:
        return None
    model = published.model
    with database.session() as session:
        if not _is_due(session, published):
            return None
    version = registry.find(database, model, published.version)
    with database.transaction() as session:
        if not _is_due(session, published):  # another thread may have queued one
            return None
        if not owner.read_options(session, model).auto_refresh:
            for each in reasons:
                _raise_once(session, model, each.trigger, texts.describe_refresh_advice(each.text), each.evidence)
            return None
        why = reasons[0]
        try:
            job = jobs.add_refresh(session, version, why.trigger)
        except ConflictError as error:
            text = texts.describe_refresh_failure(why.text, error.message)
            _raise_once(session, model, "refresh", text, why.evidence)
            return None
        except BusyError as error:
            logger.warning("model %s should be refreshed, but %s", model, error.message)
            return None
        raise_alarm(session, model, why.trigger, texts.describe_refresh(why.text), {**why.evidence, "job": job.id})
    queue.submit(job.id)
    return jobs.represent(job)


def _is_due(session: Session, published: Publication) -> bool:
    """Return whether a refresh may be queued, or an alarm raised, now."""
    model, version = published.model, published.version
    serving = session.get(ServingRow, model)
    if serving is None or serving.version != version or owner.read_pause(session, model) is not None:
        return False
    before = list(session.scalars(jobs.refreshes_of(model)))
    if any(job.state in ACTIVE for job in before):
        return False
    if _observed_s(session, model, version) < MIN_OBSERVED_S:
        return False
    if not owner.read_options(session, model).auto_promote and _is_better_known(session, model, version):
        return False
    ended = [datetime.fromisoformat(job.finished_at or job.created_at).timestamp() for job in before]
    earlier = sum(job.request["refresh"]["version"] == version for job in before)
    pause = RULE.pause_s * 2 ** min(max(earlier - 1, 0), MAX_DOUBLINGS)
    return not ended or time.time() - max(ended) >= pause


def _observed_s(session: Session, model: str, version: int) -> float:
    """Return the seconds of rows that a version has learnt while serving, summed over batches."""
    start = log.start_of(session, model, version)
    learnt = (EventRow.model == model, EventRow.number > start, EventRow.learnt > 0, EventRow.void.is_(False))
    return session.scalar(select(func.sum(EventRow.last - EventRow.first)).where(*learnt)) or 0.0


def _is_better_known(session: Session, model: str, version: int) -> bool:
    """Return whether an alarm has reported a version that predicts better than the serving one."""
    alarms = _alarms(model, "promotion").where(
        AlarmRow.evidence["serving"].as_integer() == version, AlarmRow.evidence["verdict"].as_string() == "promote"
    )
    return session.scalar(alarms.limit(1)) is not None


def _raise_once(session: Session, model: str, kind: AlarmKind, message: str, evidence: dict[str, Any]) -> None:
    """Raise an alarm unless one of this kind exists for the version."""
    known = _alarms(model, kind).where(AlarmRow.evidence["version"].as_integer() == evidence["version"])
    if session.scalar(known.limit(1)) is None:
        raise_alarm(session, model, kind, message, evidence)


def _find_reasons(published: Publication) -> Iterator[RefreshReason]:
    """Yield why a version needs a refresh: motion beyond the basis, or an arm that has left its linearisation."""
    named = f"version {published.version} of model {published.model!r}"
    revision = {"version": published.version, "revision": published.revision}
    share = published.novel_share
    if share > RULE.novelty_share:
        text = texts.describe_novelty(named, share, NOVELTY_ROWS)
        figures: dict[str, Any] = {
            "novel_share": share,
            "threshold": RULE.novelty_share,
            "rows": NOVELTY_ROWS,
            "novel_rows_since_start": published.novel_rows,
        }
        yield RefreshReason("novelty", text, {**revision, **figures})
    errors = published.linearisation or (0.0,)
    if max(errors) > RULE.linearisation_error:
        text = texts.describe_linearisation(named, max(errors))
        by_joint = {"linearisation_error": list(errors), "threshold": RULE.linearisation_error}
        yield RefreshReason("linearisation", text, {**revision, **by_joint})


def _alarms(model: str, kind: AlarmKind) -> Select[int]:
    return select(AlarmRow.seq).where(AlarmRow.model == model, AlarmRow.kind == kind)
