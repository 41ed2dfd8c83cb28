"""Refreshing the version that serves because motion, or its arm, has left what it can learn; and what ends a contest.

A refresh trains a candidate, which learns along. Once it predicts better it takes over without a query that notices,
or else it is dismissed.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from sqlalchemy import Select, select
from sqlalchemy.orm import Session

from service.contract.jobs import Job
from service.contract.learning import AlarmKind
from service.contract.states import ACTIVE
from service.foundation.errors import BusyError, ConflictError
from service.foundation.settings import Settings
from service.foundation.text import percent
from service.learning import owner
from service.learning.learner.publication import Contested, Published
from service.learning.learners import Learners
from service.models import deletion, registry
from service.models.loaded import LoadedModels
from service.storage import audit
from service.storage.database import AlarmRow, Database, LearnerRow, ServingRow
from service.training import jobs
from service.training import refresh_data as scope
from service.training.queue import JobQueue

logger = logging.getLogger(__name__)

CANDIDATE, DISMISSED = "candidate", "dismissed"
MOST_DOUBLINGS = 10


def attach(learners: Learners, queue: JobQueue) -> None:
    """Let versions be refreshed and promoted by themselves; once, before the first observation is taken."""

    def published(message: Published) -> None:
        consider(learners.settings, learners.database, queue, message)

    def contested(message: Contested) -> None:
        decide(learners.database, learners.loaded, learners.process.wake, message)

    learners.when_published.append(published)
    learners.when_contested.append(contested)


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
        if not owner.options(session, model).auto_refresh:
            for each in reasons:
                _raise_once(session, model, each.trigger, f"{each.text}: a refresh would help", each.evidence)
            return None
        why = reasons[0]
        try:
            job = jobs.add_refresh(session, settings, version, why.trigger)
        except ConflictError as error:
            text = f"{why.text}, but it cannot be refreshed: {error.message}"
            _raise_once(session, model, "refresh", text, why.evidence)
            return None
        except BusyError as error:
            logger.warning("model %s is to be refreshed, but %s", model, error.message)
            return None
        owner.raise_alarm(session, model, why.trigger, f"{why.text}: it is refreshed", {**why.evidence, "job": job.id})
    queue.submit(job.id)
    return jobs.represent(job)


def _is_due(session: Session, settings: Settings, published: Published) -> bool:
    """Whether a refresh may be queued or an alarm be raised now."""
    model, version = published.model, published.version
    serving = session.get(ServingRow, model)
    if serving is None or serving.version != version or owner.held(session, model) is not None:
        return False
    before = list(session.scalars(jobs.refreshes_of(model)))
    if any(job.state in ACTIVE for job in before):
        return False
    contest = select(LearnerRow.version).where(LearnerRow.model == model, LearnerRow.role == CANDIDATE)
    if session.scalar(contest.limit(1)) is not None:
        return False
    if not owner.options(session, model).auto_promote and _is_better_known(session, model, version):
        return False
    ended = [datetime.fromisoformat(job.finished_at or job.created_at).timestamp() for job in before]
    earlier = sum(job.request["refresh"]["version"] == version for job in before)
    pause = settings.refresh_pause_s * 2 ** min(max(earlier - 1, 0), MOST_DOUBLINGS)
    return not ended or time.time() - max(ended) >= pause


def _is_better_known(session: Session, model: str, version: int) -> bool:
    """Whether an alarm has named a version that predicts better, and the owner has not let it answer."""
    alarms = _alarms(model, "promotion").where(
        AlarmRow.evidence["serving"].as_integer() == version, AlarmRow.evidence["verdict"].as_string() == "promote"
    )
    return session.scalar(alarms.limit(1)) is not None


def _raise_once(session: Session, model: str, kind: AlarmKind, message: str, evidence: dict[str, Any]) -> None:
    known = _alarms(model, kind).where(AlarmRow.evidence["version"].as_integer() == evidence["version"])
    if session.scalar(known.limit(1)) is None:
        owner.raise_alarm(session, model, kind, message, evidence)


def _reasons(settings: Settings, published: Published) -> Iterator[Reason]:
    """What the revision shows that a refresh mends: motion beyond the basis, an arm that has left its linearisation."""
    named = f"version {published.version} of model {published.model!r}"
    revision = {"version": published.version, "revision": published.revision}
    share = published.novel_share
    if share > settings.novelty_share:
        text = f"{percent(share)} of the last {settings.novelty_rows} samples lie beyond what {named} can learn"
        figures: dict[str, Any] = {
            "novel_share": share,
            "threshold": settings.novelty_share,
            "rows": settings.novelty_rows,
            "novel_rows_since_start": published.novel_rows,
        }
        yield Reason("novelty", text, {**revision, **figures})
    errors = published.linearisation or (0.0,)
    if max(errors) > settings.linearisation_error:
        text = (
            f"the arm of {named} has moved from where its torque is linear: {percent(max(errors))} of the stated error"
        )
        by_joint = {"linearisation_error": list(errors), "threshold": settings.linearisation_error}
        yield Reason("linearisation", text, {**revision, **by_joint})


def _alarms(model: str, kind: AlarmKind) -> Select[int]:
    return select(AlarmRow.seq).where(AlarmRow.model == model, AlarmRow.kind == kind)


def decide(database: Database, loaded: LoadedModels, wake: Callable[[str], None], contested: Contested) -> bool:
    """Act on the verdict of a contest; return whether the candidate answers now. Not for the event loop.

    The pointer to the version that serves, the roles of both and the alarm change in one transaction; queries follow by
    one assignment, once the candidate is in memory with what it has learnt so far. A verdict is void where another
    version serves by now, or where the candidate is one no more. Else old versions of refreshes are deleted after it.
    wake: tells the learner of a model that roles changed.
    """
    model, candidate = contested.model, contested.candidate
    with database.transaction() as session:
        learner = session.get(LearnerRow, (model, candidate))
        serving = session.get(ServingRow, model)
        if learner is None or learner.role != CANDIDATE or serving is None or serving.version != contested.serving:
            logger.info("the contest of version %d of model %s is void: roles have changed", candidate, model)
            return False
        promoted = _act(session, contested, learner)
    if promoted:
        loaded.adopt(model)
    wake(model)
    deletion.delete_refreshed(loaded, model)
    return promoted


def _act(session: Session, contested: Contested, learner: LearnerRow) -> bool:
    """Change roles as the verdict says, and note why; return whether the candidate serves."""
    model, old, new = contested.model, contested.serving, contested.candidate
    learner.role, promoted = DISMISSED, False  # unless it serves
    if contested.verdict == "dismiss":
        message = f"version {new} does not predict better than version {old} and is dismissed"
    elif scope.taken_back(session, model, learner.start, learner.start):
        message = f"version {new} is dismissed: part of what it was trained on has been taken back since"
    elif not owner.options(session, model).auto_promote:
        message = f"version {new} predicts better than version {old}: a rollback to version {new} lets it answer"
    else:
        registry.serve(session, model, new)
        message, promoted = f"version {new} predicts better than version {old} and answers from now on", True
    if not promoted:
        audit.note(session, model, "candidate dismissed", new, after={"verdict": contested.verdict, "serving": old})
    named = {"serving": old, "candidate": new, "verdict": contested.verdict, "promoted": promoted}
    owner.raise_alarm(session, model, "promotion", message, {**named, **contested.evidence})
    return promoted
