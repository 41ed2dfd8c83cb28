"""What follows a contest: a refreshed version takes over without a query that notices, or is dismissed."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from sqlalchemy.orm import Session

from service.journal import alarms
from service.learning import learning
from service.learning.learner.messages import Contested
from service.models import registry
from service.models.loaded import LoadedModels
from service.storage.database import Database, LearnerRow, ServingRow
from service.training import refresh_data

logger = logging.getLogger(__name__)

CANDIDATE, DISMISSED = "candidate", "dismissed"


def decide(database: Database, loaded: LoadedModels, wake: Callable[[str], None], contested: Contested) -> bool:
    """Act on the verdict of a contest; return whether the candidate answers now. Not for the event loop.

    The pointer to the version that serves, the roles of both and the alarm change in one transaction; queries follow by
    one assignment, once the candidate is in memory with what it has learnt so far. A verdict is void where another
    version serves by now, or where the candidate is one no more. wake: tells the learner of a model that roles changed.
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
    return promoted


def _act(session: Session, contested: Contested, learner: LearnerRow) -> bool:
    """Change roles as the verdict says, and note why; return whether the candidate serves."""
    model, old, new = contested.model, contested.serving, contested.candidate
    learner.role = DISMISSED  # unless it serves
    if contested.verdict == "dismiss":
        _note(session, contested, f"version {new} does not predict better than version {old} and is dismissed", False)
        return False
    if refresh_data.taken_back(session, model, learner.start, learner.start):
        message = f"version {new} is dismissed: part of what it was trained on has been taken back since"
        _note(session, contested, message, False)
        return False
    if not learning.options(session, model).auto_promote:
        message = f"version {new} predicts better than version {old}: a rollback to version {new} lets it answer"
        _note(session, contested, message, False)
        return False
    registry.serve(session, model, new)
    _note(session, contested, f"version {new} predicts better than version {old} and answers from now on", True)
    return True


def _note(session: Session, contested: Contested, message: str, promoted: bool) -> None:
    evidence: dict[str, Any] = {
        "serving": contested.serving,
        "candidate": contested.candidate,
        "verdict": contested.verdict,
        "promoted": promoted,
        **contested.evidence,
    }
    alarms.raise_alarm(session, contested.model, "promotion", message, evidence)
