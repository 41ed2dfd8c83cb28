"""The training process: run one job, from its row to a new model version."""

from __future__ import annotations

import logging
import resource
import sys
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from sqlalchemy.orm import Session

import lipcore
from lipcore.data.samples import Samples
from lipcore.extras import MissingExtraError
from lipcore.model.torque_model import TorqueModel
from lipcore.model.warnings import REFIT_ERROR
from service.contract.models import Promotion
from service.contract.states import CANCELLED, FAILED, QUEUED, RUNNING, SUCCEEDED, JobState, PromotionOption
from service.foundation.errors import NotInstalledError, ServiceError, StorageFullError, StorageUnavailableError
from service.foundation.settings import Settings
from service.models import registry
from service.models.evaluation import MAX_EVALUATION_SAMPLES
from service.models.lineage import MAX_METRIC_SAMPLES, figures, software
from service.runtime.allocator import release_memory
from service.runtime.executors import ClusterUnavailableError
from service.storage import errors as storage_errors
from service.storage.database import Database, JobRow, VersionRow, now
from service.storage.disk import Disk
from service.storage.files import PATIENCE_S, Files
from service.telemetry.logs import job_id
from service.training import judging, lifecycle, promotion, refresh_data, refreshed, texts
from service.training.holding_out import CannotHoldOutError
from service.training.material import TrainingData, load_datasets, load_refresh_data
from service.training.planned_fit import PlannedFit
from service.training.pulse import Heartbeat, SupersededError

logger = logging.getLogger(__name__)


class StorageError(RuntimeError):
    """The database or the disk could not be used; the job has not failed and must be started again."""


class TakenBackError(RuntimeError):
    """Training data of the job were unlearnt or rolled back meanwhile."""

    code = "observations_taken_back"


def run(settings: Settings, job: str) -> None:
    """Run one queued job to its end. Every outcome is written to its row; a failed fit raises nothing.

    Raise StorageError if the outcome cannot be written or required data cannot be read.
    """
    token = job_id.set(job)
    database, files = _database(settings), Files.of(settings, PATIENCE_S)
    try:
        claim = _claim(database, job)
        if claim is not None:
            _train(settings, database, files, claim)
    finally:
        database.close()
        job_id.reset(token)
        release_memory()  # return free memory, as the process waits for the next job


@lru_cache(1)
def _database(settings: Settings) -> Database:
    """Return one database for all jobs of a process: SQLAlchemy keeps what it compiles for each database, 0.1 MiB."""
    return Database.of(settings)


@dataclass(frozen=True)
class Claim:
    """One attempt at a job."""

    job: str
    attempt: int
    model: str
    request: dict[str, Any]


def _claim(database: Database, job: str) -> Claim | None:
    with database.transaction() as session:
        row = lifecycle.row_of(session, job)
        if row is None or row.state != QUEUED:
            return None
        row.attempts += 1
        lifecycle.enter(row, RUNNING, texts.describe_started(row.attempts, lifecycle.LIMITS.attempts))
        row.started_at = row.heartbeat_at = now()
        row.progress = {"stage": "loading"}
        return Claim(job, row.attempts, row.model, row.request)


def _train(settings: Settings, database: Database, files: Files, claim: Claim) -> None:
    try:
        with Heartbeat(
            database, lambda session: _own(session, claim), claim.model, lifecycle.LIMITS.heartbeat_s
        ) as heartbeat:
            if claim.request.get("refresh") is None:
                data = load_datasets(database, files, claim.request)
            else:
                data = load_refresh_data(database, files, claim.model, claim.request)
            trained, lineage, judged = _version(settings, database, files, claim, data, heartbeat)
            heartbeat.stage("saving")
            folder = lifecycle.new_folder(claim.job)
            Disk(settings).require()
            with files.new_version(folder) as target:
                manifest = lipcore.save(trained, target, lineage)
        with database.transaction() as session:
            row = _own(session, claim)
            if row.cancel_requested:
                raise lipcore.FitCancelledError("cancelled before the version was added")
            row.version, outcome = _publish(session, settings, claim, data, folder, manifest, judged)
            row.progress = {**heartbeat.as_json(), "stage": "done", "fraction": 1.0, "remaining_s": 0.0}
            lifecycle.enter(row, SUCCEEDED, texts.describe_outcome(row.version, outcome))
    except lipcore.FitCancelledError:
        _finish(database, files, claim, CANCELLED, texts.CANCELLED_RUNNING)
    except SupersededError:
        logger.warning("%s was taken over by another attempt", claim.job)
    except Exception as error:
        # an error for users says what to do: it needs no traceback
        logger.error("%s failed: %s", claim.job, error, exc_info=not isinstance(error, ServiceError))
        unavailable = isinstance(error, ClusterUnavailableError)
        if unavailable or isinstance(storage_errors.translate_error(error), StorageUnavailableError):
            raise StorageError(str(error)) from None  # a later attempt may succeed
        _finish(database, files, claim, FAILED, f"{type(error).__name__}: {error}", _code(error))


def _version(
    settings: Settings, database: Database, files: Files, claim: Claim, data: TrainingData, heartbeat: Heartbeat
) -> tuple[TorqueModel, dict[str, Any], Promotion]:
    """Return a version's model, its lineage and the decision on its promotion, which precedes the last fit."""
    fit = PlannedFit.of(claim.request, data)
    last = None if data.every is None else PlannedFit.of(claim.request, data.for_last_fit())
    trained = fit.first(settings, claim.request["estimator"], last, heartbeat)
    lineage = {"job": claim.job, **data.lineage}
    if data.held_out is not None:
        heartbeat.stage("evaluating")
        lineage["holdout"] = {**lineage["holdout"], **judging.judged_figures(trained, data)}
    judged_on = _judged_on(data)
    judged = _judged(settings, database, files, claim, data, trained, judged_on, lineage)
    if data.held_out is not None and judged_on is not None and claim.request.get("refresh") is None:
        heartbeat.stage("learning_curve")
        lineage["holdout"]["learning_curve"] = fit.learning_curve(trained, judged_on, heartbeat)
    learnt = data
    if last is not None and judged_on is not None:
        trained = last.last(settings, trained, judged_on, heartbeat)
        if REFIT_ERROR not in trained.fit:
            learnt = last.data
            if data.learns_held_out:
                lineage["holdout"]["learnt"] = True
    lineage |= {
        "trained_at": now(),
        "training_process": {"seconds": round(heartbeat.elapsed, 1), "peak_memory_mb": _peak_memory_mb()},
        "software": software(),
        "training_metrics": figures(trained, learnt.samples, MAX_METRIC_SAMPLES, learnt.rows),
    }
    return trained, lineage, judged


def _option(settings: Settings, claim: Claim) -> PromotionOption:
    """Return the promotion option of the job, or else of the settings."""
    option: PromotionOption = claim.request.get("promotion") or settings.promotion
    return option


def _judged_on(data: TrainingData) -> Samples | None:
    """Return the rows that a version is judged on: for a refresh the newest logged rows, else the held-out rows."""
    if data.unlearnt is not None:
        return data.unlearnt.samples
    return None if data.held_out is None else data.held_out.thinned(MAX_EVALUATION_SAMPLES)


def _judged(
    settings: Settings,
    database: Database,
    files: Files,
    claim: Claim,
    data: TrainingData,
    trained: TorqueModel,
    judged_on: Samples | None,
    lineage: dict[str, Any],
) -> Promotion:
    """Return whether the version serves; add the figures behind that to the lineage."""
    refresh = claim.request.get("refresh")
    if refresh is None:
        option = _option(settings, claim)
        return promotion.judge(database, files, claim.model, trained, judged_on, lineage, option)
    with database.session() as session:
        serving = session.get_one(VersionRow, (claim.model, refresh["version"]))
    return refreshed.judge(database, files, serving, trained, data.unlearnt, lineage)


def _publish(
    session: Session,
    settings: Settings,
    claim: Claim,
    data: TrainingData,
    folder: str,
    manifest: dict[str, Any],
    judged: Promotion,
) -> tuple[int, str]:
    """Add the trained version; return its number and the outcome in words."""
    if (refresh := claim.request.get("refresh")) is None:
        judged = promotion.settle(session, claim.model, judged, _option(settings, claim))
        waits = not judged.answers
        version = registry.publish(session, claim.model, folder, manifest, claim.job, candidate=waits, promotion=judged)
        if waits:
            promotion.wait(session, claim.model, version)
        return version, texts.describe_promotion(judged.answers, judged.reason)
    if refresh_data.is_taken_back(session, claim.model, refresh["through"], data.seen):
        raise TakenBackError(texts.TAKEN_BACK)
    start, evidence = refresh["through"], manifest["lineage"]["refresh"]["evidence"]
    version = registry.publish(session, claim.model, folder, manifest, claim.job, True, start, judged)
    return version, refreshed.promote(session, claim.model, version, judged, evidence)


def _code(error: Exception) -> str:
    """Return the error code of a failed job."""
    if isinstance(storage_errors.translate_error(error), StorageFullError):
        return StorageFullError.code
    if isinstance(error, (TakenBackError, CannotHoldOutError, ServiceError)):  # ServiceError: a damaged data set
        return error.code
    if isinstance(error, MissingExtraError):
        return NotInstalledError.code
    return "not_positive_definite" if isinstance(error, lipcore.NotPositiveDefiniteError) else "training_failed"


def _peak_memory_mb() -> int:
    """Return the peak resident memory of this process, earlier jobs included, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(peak / (1024 * 1024 if sys.platform == "darwin" else 1024))


def _own(session: Any, claim: Claim) -> JobRow:
    """Return the job's row; raise SupersededError if a restarted service has given the job to another attempt."""
    row = lifecycle.row_of(session, claim.job)
    if row is None or row.state != RUNNING or row.attempts != claim.attempt:
        raise SupersededError(claim.job)
    return row


def _finish(
    database: Database, files: Files, claim: Claim, state: JobState, message: str, code: str | None = None
) -> None:
    with database.transaction() as session:
        row = _own(session, claim)
        lifecycle.enter(row, state, message)
        row.error = None if code is None else {"code": code, "message": message}
    lifecycle.remove_leftovers(database, files, claim.job)
