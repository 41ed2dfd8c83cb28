"""The decisions of a model's owner: options, the end of a pause, replays, unlearning and rollbacks."""

from __future__ import annotations

import time
from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from lipcore.estimators.base import RobotKind
from lipcore.online.batch import Rows
from lipcore.vocabulary import CODES, Code
from service.contract import learning as schema
from service.contract.observations import LearningOptions
from service.foundation.errors import ConflictError, invalid_request, not_found, problem
from service.journal import log, undo
from service.journal.alarms import add_event
from service.journal.alarms import page as alarms_page
from service.learning import owner, texts
from service.learning.control import status
from service.learning.ingest.observations import read_state
from service.learning.learners import Learners
from service.models import registry
from service.storage import audit
from service.storage.database import Database, EventRow, LearnerRow, VersionRow
from service.storage.rows import Page

UNDONE_TEXTS = {"unlearnt": "has been unlearnt", "rolled_back": "was undone by a rollback"}


def find_serving_version(database: Database, model: str) -> int:
    """Return the serving version; raise NotFoundError for an unknown model."""
    return registry.find(database, model, None).version


def read_revision(session: Session, model: str, version: int) -> schema.Revised:
    """Return the revision of a version that contains everything logged so far."""
    return schema.Revised(model=model, version=version, revision=status.read_newest_revision(session, model, version))


def find_learnt(session: Session, model: str, stream_id: str, sequence: int) -> EventRow:
    """Return the batch with exactly this sequence; raise NotFoundError, or ConflictError if it was undone."""
    batch = status.find_batch(session, model, stream_id, sequence)
    if batch.sequence != sequence:
        message = (
            f"Frames {batch.sequence} to {batch.last_sequence} were logged together: use sequence {batch.sequence}."
        )
        raise invalid_request("sequence", sequence, str(batch.sequence), message)
    if batch.void:
        raise ConflictError(f"batch {sequence} of stream {stream_id!r} {UNDONE_TEXTS[read_state(session, batch)]}")
    return batch


def unlearn(learners: Learners, model: str, stream_id: str, sequence: int) -> schema.Unlearnt:
    """Unlearn a batch and its replays; raise NotFoundError or ConflictError."""
    version = find_serving_version(learners.database, model)
    with learners.database.turn(model), learners.database.transaction(model) as session:
        batch = find_learnt(session, model, stream_id, sequence)
        if log.start_of(session, model, version) < batch.number:
            _check_fold(session, model, version, batch)
        rows = batch.learnt + sum(each.learnt for each in log.find_related(session, batch, "replay") if not each.void)
        trained = select(LearnerRow.version).where(LearnerRow.model == model, LearnerRow.start >= batch.number)
        versions = list(session.scalars(trained.order_by(LearnerRow.version)))
        undo.unlearn(session, model, batch, time.time())
        revised = read_revision(session, model, version)
        taken = {"stream_id": stream_id, "sequence": sequence, "rows": rows}
        audit.note(session, model, "observations unlearnt", version, before=taken)
    learners.process.wake(model)
    return schema.Unlearnt(**revised.model_dump(), stream_id=stream_id, sequence=sequence, rows=rows, trained=versions)


def _check_fold(session: Session, model: str, version: int, batch: EventRow) -> None:
    """Raise ConflictError if the state of a version cannot be reconstructed without a batch."""
    if not undo.can_fold_again(session, model, version, batch.number):
        name = f"batch {batch.sequence} of stream {batch.stream_id!r}"
        raise ConflictError(
            f"{name} can no longer be unlearnt: the log does not reach back to a stored state without it. Roll back to "
            "an earlier revision, or retrain the model"
        )


def delete_stream(learners: Learners, model: str, stream_id: str) -> None:
    """Delete a stream; raise NotFoundError."""
    served = learners.loaded.get(model, None)
    monitor = learners.monitor(model)
    with learners.turn(model):
        with learners.database.transaction(model) as session:
            row = log.stream(session, model, stream_id)
            if row is None:
                raise not_found("stream", stream_id)
            session.delete(row)
            audit.note(session, model, "stream deleted", before={"stream_id": stream_id})
        monitor.streams.forget(stream_id)
        if served.carrier is not None:
            served.payloads.replace(monitor.payloads.build_models(served.carrier, served.version))
        served.scales.replace(monitor.streams.factors(served.version))


def rollback(learners: Learners, model: str, request: schema.RollbackRequest) -> schema.RolledBack:
    """Roll back to a revision of the serving version, or to another version.

    Raise InvalidRequestError unless the request names exactly one of the two, or if the revision is not older than the
    newest. Raise NotFoundError, and ConflictError if the state cannot be reconstructed.
    """
    if (request.revision is None) == (request.version is None):
        given = "neither" if request.revision is None else "both"
        message = f"Expected either `revision` or `version`, got {given}."
        raise invalid_request("revision or version", given, "exactly one of the two", message)
    if request.version is not None:
        return _to_version(learners, model, request.version)
    assert request.revision is not None
    return _to_revision(learners, model, request.revision)


def _to_revision(learners: Learners, model: str, revision: int) -> schema.RolledBack:
    version = find_serving_version(learners.database, model)
    served, monitor = learners.loaded.get(model, version), learners.monitor(model)
    with learners.turn(model), learners.database.transaction(model) as session:
        newest = status.read_newest_revision(session, model, version)
        if revision >= newest:
            raise invalid_request("revision", revision, f"less than {newest}, the newest of version {version}")
        _check_reach(revision, version, status.list_reachable(session, model, version))
        to = log.start_of(session, model, version) + revision
        undone = select(func.count()).where(
            EventRow.model == model,
            EventRow.number > to,
            EventRow.kind.in_(("batch", "replay")),
            EventRow.void.is_(False),
        )
        count = session.scalar(undone) or 0
        undo.rollback(session, model, to, time.time())
        session.flush()
        monitor.streams.restore_scales(session, model, version, served.base.scale)
        revised = read_revision(session, model, version)
        audit.note(session, model, "learning rolled back", version, before=newest, after=revision)
    served.scales.replace(monitor.streams.factors(version))
    learners.process.wake(model)
    return schema.RolledBack(**revised.model_dump(), undone=count, complete=True)


def _check_reach(revision: int, version: int, ranges: list[status.Range]) -> None:
    """Raise ConflictError, naming the revisions that can be restored, if this one cannot."""
    if status.is_reachable(revision, ranges):
        return
    oldest = next((first for first, last in ranges if last > 0), 0)
    listed = ", ".join(str(first) if first == last else f"{first} to {last}" for first, last in ranges)
    raise ConflictError(
        f"revision {revision} of version {version} cannot be restored: its snapshots and log are no longer kept, or a "
        f"rollback has undone it. Apart from 0, as trained, the oldest revision that can be restored is {oldest}",
        [problem("revision", revision, f"one of {listed}")],
    )


def _to_version(learners: Learners, model: str, version: int) -> schema.RolledBack:
    if version == find_serving_version(learners.database, model):
        raise ConflictError(f"version {version} of model {model!r} is already the serving version")
    learners.loaded.get(model, version)  # load first: no request waits for it, and it fails before the change
    with learners.database.transaction() as session:
        manifest = session.get_one(VersionRow, (model, version)).manifest
        registry.check_robot(session, model, RobotKind.of_manifest(manifest))
        registry.serve(session, model, version)
        revised = read_revision(session, model, version)
        complete = status.is_reachable(revised.revision, status.list_reachable(session, model, version))
    learners.loaded.adopt(model)
    learners.process.wake(model)
    return schema.RolledBack(**revised.model_dump(), undone=0, complete=complete)


CHANGE = "change"
CHUNK_EVENTS = 50
"""Events that are replayed in one transaction, so that observations do not wait long for the lock."""


def set_options(learners: Learners, model: str, options: LearningOptions) -> None:
    """Set how a model learns from now on; raise NotFoundError or InvalidRequestError."""
    joints = registry.find(learners.database, model, None).manifest["joint_names"]
    owner.set_options(learners.database, model, options, len(joints), time.time())
    if not options.adaptive_intervals:
        for scales in learners.loaded.scales(model).values():
            scales.replace({})
    learners.process.wake(model)


def decide(learners: Learners, model: str, request: schema.ChangeRequest) -> schema.Decided:
    """End a pause; raise NotFoundError, or ConflictError if learning is not paused.

    The change is logged first and the pause ends last. In between, the rows that were kept out are replayed in chunks.
    An interrupted decision continues when it is requested again.
    """
    version = find_serving_version(learners.database, model)
    rows, done, ended = 0, None, False
    while not ended:
        # a batch is judged and logged in one turn: none is judged in the pause and logged after it
        with learners.turn(model), learners.database.transaction(model) as session:
            held = _read_pause(session, model)
            if request.decision == "adapt":
                _log_change(session, model, held)
            done = held["event"] - 1 if done is None else done
            pending = log.events(session, model, done, CHUNK_EVENTS) if request.replay else []
            for event in pending:
                if event.kind == "batch":
                    rows += sum(log_replay(session, event, [CHANGE], time.time()).values())
            ended = len(pending) < CHUNK_EVENTS
            if ended:
                owner.resume(session, model)
                decided = {"decision": request.decision, "rows": rows}
                audit.note(session, model, "change decided", version, before=held, after=decided)
                add_event(session, "alarm.cleared", model, "change", texts.describe_decision(request.decision), decided)
            else:
                done = pending[-1].number
            revised = read_revision(session, model, version)
    learners.process.wake(model)
    return schema.Decided(**revised.model_dump(), decision=request.decision, at=held["at"], rows=rows)


def replay(
    learners: Learners, model: str, stream_id: str, sequence: int, request: schema.ReplayRequest
) -> schema.Replayed:
    """Learn the rows of a batch that were kept out with some codes, once each.

    Raise NotFoundError, InvalidRequestError if the batch has no such rows, and ConflictError if it was undone or all of
    these rows have been replayed.
    """
    version = find_serving_version(learners.database, model)
    codes = schema.REPLAYABLE if request.codes is None else request.codes
    with learners.database.turn(model), learners.database.transaction(model) as session:
        batch = find_learnt(session, model, stream_id, sequence)
        learnt = log_replay(session, batch, codes, time.time())
        if not learnt:
            raise _refusal(session, batch, codes)
        revised = read_revision(session, model, version)
        named = {"stream_id": stream_id, "sequence": sequence, "rows": learnt}
        audit.note(session, model, "observations replayed", version, after=named)
    learners.process.wake(model)
    return schema.Replayed(
        **revised.model_dump(), stream_id=stream_id, sequence=sequence, rows=sum(learnt.values()), codes=learnt
    )


def log_replay(session: Session, batch: EventRow, codes: Collection[str], received: float) -> dict[str, int]:
    """Log a replay of the rows with these codes that no earlier replay has learnt; return their counts.

    Nothing is logged if there are none. Rows with a wrong time count as of their arrival. Times are those of the
    model's own clock.
    """
    pending = set(codes) - _replayed(session, batch)
    rows = log.learning_rows(batch)
    chosen = _complete(rows) & np.isin(rows.code, [CODES.index(code) for code in pending])
    taken = rows.take(chosen)
    counts = taken.rejected()
    if counts:
        arrived = batch.received if batch.clock is None else batch.clock
        times = np.where(taken.code == Code.TIME_JUMP, arrived, taken.time)
        learnt = replace(taken, time=times, code=np.full(len(taken), Code.LEARNT, np.uint8))
        detail = {"event": batch.number, "codes": list(counts)}
        log.append(session, batch.model, "replay", detail, received, learnt)
    return counts


def alarms(learners: Learners, model: str, part: Page) -> schema.AlarmPage:
    """Return the alarms of a model, newest first; raise NotFoundError for an unknown model."""
    registry.find(learners.database, model, None)
    with learners.database.session() as session:
        rows, following = alarms_page(session, model, part)
    names = ("kind", "at", "message", "evidence")
    items = [schema.Alarm(id=row.seq, **{name: getattr(row, name) for name in names}) for row in rows]
    return schema.AlarmPage(items=items, next_cursor=following)


def _replayed(session: Session, batch: EventRow) -> set[str]:
    """Return the codes of rows that have been replayed. Rows that a rollback has undone can be replayed again."""
    events = log.find_related(session, batch, "replay")
    return {code for event in events if not event.void for code in (event.detail or {})["codes"]}


def _complete(rows: Rows) -> NDArray[np.bool_]:
    """Return which rows have only finite numbers, (N,). Rows without a derived acceleration have not."""
    numbers = np.hstack([rows.time[:, None], rows.q, rows.dq, rows.ddq, rows.tau])
    return np.asarray(np.isfinite(numbers).all(axis=1))


def _refusal(session: Session, batch: EventRow, codes: Collection[str]) -> Exception:
    """Return the error that explains why no row of a batch is left to replay."""
    rows, name = log.rows_of(batch), f"batch {batch.sequence} of stream {batch.stream_id!r}"
    counts = rows.take(_complete(rows)).rejected()
    offered = [code for code in schema.REPLAYABLE if code in counts]
    if done := [code for code in offered if code in codes and code in _replayed(session, batch)]:
        return ConflictError(f"rows of {name} with the code {', '.join(done)} have already been replayed")
    has = f"codes of rows of {name} that can be learnt: {', '.join(offered) or 'there are none'}"
    return invalid_request("codes", ", ".join(codes), has)


def _read_pause(session: Session, model: str) -> dict[str, Any]:
    held = owner.read_pause(session, model)
    if held is None:
        raise ConflictError(f"learning of model {model!r} is not paused: there is nothing to decide")
    return held


def _log_change(session: Session, model: str, held: dict[str, Any]) -> None:
    """Log the change for which learning is paused, unless an interrupted decision has."""
    query = select(EventRow.seq).where(
        EventRow.model == model, EventRow.number >= held["event"], EventRow.kind == "change", EventRow.void.is_(False)
    )
    if session.scalar(query.limit(1)) is None:
        log.append(session, model, "change", {"t": held["at"]}, time.time())
