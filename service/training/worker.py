"""What the training process does: one job, from its row to a new model version."""

from __future__ import annotations

import logging
import resource
import sys
import time
from dataclasses import dataclass
from typing import Any

from sqlalchemy import select, update
from sqlalchemy.orm import Session

import lipcore
from lipcore.fitting import FitProgress
from lipcore.model import TorqueModel
from lipcore.online.conditioning import condition
from service.database import Database, JobRow, LearnerRow, now
from service.files import Files, new_id
from service.models import registry
from service.settings import Settings
from service.training.material import Material, observed, recorded
from service.training.states import CANCELLED, FAILED, QUEUED, RUNNING, SUCCEEDED
from service.updates.refreshing import scope

logger = logging.getLogger(__name__)

REPORT_EVERY = 0.5
"""Seconds between two looks at the database: progress out, cancel flag in."""


class SupersededError(RuntimeError):
    """The job is no longer this attempt's."""


class TakenBackError(RuntimeError):
    """What the job was training on has been unlearnt or rolled back meanwhile."""


def run(settings: Settings, job: str) -> None:
    """Run one queued job to its end. All outcomes are written to its row; nothing is raised for a failed fit."""
    database, files = Database(settings.home), Files(settings.home)
    try:
        claim = _claim(database, job)
        if claim is not None:
            _train(settings, database, files, claim)
    finally:
        database.close()


@dataclass(frozen=True)
class Claim:
    """One attempt at a job."""

    job: str
    attempt: int
    model: str
    request: dict[str, Any]


def _claim(database: Database, job: str) -> Claim | None:
    with database.transaction() as session:
        row = session.scalar(select(JobRow).where(JobRow.id == job))
        if row is None or row.state != QUEUED:
            return None
        row.state, row.attempts = RUNNING, row.attempts + 1
        row.started_at = row.heartbeat_at = now()
        row.progress = {"stage": "loading"}
        return Claim(job, row.attempts, row.model, row.request)


def _train(settings: Settings, database: Database, files: Files, claim: Claim) -> None:
    watch = _Watch(database, claim)
    try:
        material = _material(settings, database, files, claim)
        trained = _fit(claim, material, watch)
        lineage = {
            "job": claim.job,
            **material.lineage,
            "trained_at": now(),
            "training_process": {"seconds": round(watch.elapsed, 1), "peak_memory_mb": _peak_memory_mb()},
        }
        watch.stage("saving")
        folder = new_id("mv")
        manifest = lipcore.save(trained, files.versions / folder, lineage)
        with database.transaction() as session:
            row = _own(session, claim)
            if row.cancel_requested:
                raise lipcore.FitCancelledError("cancelled after the last look at the flag")
            version = _publish(session, claim, material, folder, manifest)
            row.state, row.version, row.finished_at = SUCCEEDED, version, now()
            row.progress = {**row.progress, "stage": "done", "fraction": 1.0, "elapsed_s": watch.elapsed}
    except lipcore.FitCancelledError:
        _finish(database, claim, CANCELLED, None)
    except SupersededError:
        logger.warning("job %s was taken over by another attempt", claim.job)
    except Exception as error:
        logger.exception("job %s failed", claim.job)
        _finish(database, claim, FAILED, {"code": _code(error), "message": f"{type(error).__name__}: {error}"})


def _material(settings: Settings, database: Database, files: Files, claim: Claim) -> Material:
    if claim.request.get("refresh") is None:
        return recorded(database, files, claim.request)
    return observed(settings, database, files, claim.model, claim.request)


def _fit(claim: Claim, material: Material, watch: _Watch) -> TorqueModel:
    request = claim.request
    trained = lipcore.train(
        material.samples,
        request["joint_types"],
        request["estimator"],
        lipcore.FitOptions(**request["options"]),
        torque_convention=material.torque_convention,
        on_progress=watch.progress,
        cancelled=watch.cancelled,
        robot=material.robot,
    )
    if request.get("refresh") is None:
        return trained
    # the version that serves has learnt all of these rows, not only the few that a fit chooses
    return condition(trained, material.samples, material.weights, watch.cancelled)


def _publish(session: Session, claim: Claim, material: Material, folder: str, manifest: dict[str, Any]) -> int:
    """Add the version that was trained: it answers from then on; one of a refresh has to prove better first."""
    refresh = claim.request.get("refresh")
    if refresh is None:
        return registry.publish(session, claim.model, folder, manifest, claim.job)
    if scope.taken_back(session, claim.model, refresh["through"], material.seen):
        raise TakenBackError("part of what was observed has been taken back while it was trained on: refresh again")
    earlier = (LearnerRow.model == claim.model, LearnerRow.role == "candidate")
    session.execute(update(LearnerRow).where(*earlier).values(role="dismissed"))  # the newer one has seen more
    return registry.publish(session, claim.model, folder, manifest, claim.job, candidate=True, start=refresh["through"])


def _code(error: Exception) -> str:
    """Stable word for why a job failed."""
    if isinstance(error, TakenBackError):
        return "observations_taken_back"
    return "not_positive_definite" if isinstance(error, lipcore.NotPositiveDefiniteError) else "training_failed"


def _peak_memory_mb() -> int:
    """Largest resident memory of this process so far; earlier jobs of the same process count too."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(peak / (1024 * 1024 if sys.platform == "darwin" else 1024))


class _Watch:
    """Writes progress to the job's row and reads its cancel flag, at most every REPORT_EVERY seconds."""

    def __init__(self, database: Database, claim: Claim) -> None:
        self.database, self.claim = database, claim
        self.began, self.looked = time.monotonic(), 0.0
        self.latest: dict[str, Any] = {"stage": "hyperparameters"}
        self.stop = False

    @property
    def elapsed(self) -> float:
        return time.monotonic() - self.began

    def progress(self, at: FitProgress) -> None:
        self.latest = {
            "stage": at.stage,
            "iteration": at.iteration,
            "max_iterations": at.max_iterations,
            "objective": at.objective,
            "fraction": at.fraction,
        }
        self._exchange(force=at.stage != "hyperparameters")

    def stage(self, name: str) -> None:
        self.latest = {**self.latest, "stage": name}
        self._exchange(force=True)

    def cancelled(self) -> bool:
        self._exchange()
        return self.stop

    def _exchange(self, force: bool = False) -> None:
        if not force and time.monotonic() - self.looked < REPORT_EVERY:
            return
        self.looked = time.monotonic()
        with self.database.transaction() as session:
            row = _own(session, self.claim)
            row.progress, row.heartbeat_at = {**self.latest, "elapsed_s": self.elapsed}, now()
            self.stop = row.cancel_requested


def _own(session: Any, claim: Claim) -> JobRow:
    """Return the job's row while it still is this attempt's; a restarted service may have given it away."""
    row: JobRow | None = session.scalar(select(JobRow).where(JobRow.id == claim.job))
    if row is None or row.state != RUNNING or row.attempts != claim.attempt:
        raise SupersededError(claim.job)
    return row


def _finish(database: Database, claim: Claim, state: str, error: dict[str, str] | None) -> None:
    with database.transaction() as session:
        row = _own(session, claim)
        row.state, row.error, row.finished_at = state, error, now()
