"""The learnt state of a version: its newest snapshot, and the fold of the events since.

The state after event k is the fold of the events up to k that are not void. To undo is to mark events void and to
delete the snapshots that contain them, in one transaction. A process with void events in its state folds the log
again from the newest remaining snapshot. So the state is a function of the log, to the last bit, whichever process
computes it, when, and in however many steps. Services that share a log return the same answers. (This requires the same
release, kind of processor and number of threads.)

This is true while the log is complete. If `snapshots.retain` has deleted events that a state lacks, the newest snapshot
of any service is used. Without a snapshot, the remaining events are learnt. If a state cannot be folded again without
an unlearnt batch, the batch stays in the state.

The log is read in bounded pages, so that revisions can be published and other versions advance between pages.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from sqlalchemy import bindparam, select
from sqlalchemy.orm import Session, defer, undefer

from lipcore.model.torque_model import TorqueModel
from lipcore.online import transfer as state
from lipcore.online.learner import NovelRowsCallback, OnlineModel
from service.journal import log, snapshots, undo
from service.journal.log import Memory
from service.storage.database import Database, EventRow, fetch
from service.storage.files import Files

logger = logging.getLogger(__name__)

PAGE_ROWS = 500
"""Max rows learnt in one step, unless one batch has more.

For seven joints, that takes about 15 ms with the learnt arm, and up to 0.4 s with many inducing outputs.
"""
PAGE_EVENTS = 200
"""Max events of one page."""

_NOT_UNDONE = (
    EventRow.model == bindparam("model"),
    EventRow.number > bindparam("after"),
    EventRow.number <= bindparam("through"),
    EventRow.void.is_(False),
)
_SIZES = select(EventRow.rows).where(*_NOT_UNDONE).order_by(EventRow.number).limit(PAGE_EVENTS)
_EVENTS = (  # without reports and records, which are large and not learnt
    select(EventRow)
    .where(*_NOT_UNDONE)
    .order_by(EventRow.number)
    .limit(bindparam("count"))
    .options(undefer(EventRow.payload), defer(EventRow.report), defer(EventRow.record))
)


@dataclass(frozen=True)
class RestoredState:
    """The learnt state of a version after event `number`."""

    model: str
    version: int
    start: int
    """Last event that the training of the version used; 0 if it used none."""
    online: OnlineModel
    number: int
    """Last event that `online` contains."""
    seen: int
    """Last event up to which undoing is taken into account."""
    torn: bool = False
    """Whether the newest snapshot is unreadable. If so, gaps of the log are skipped."""


def restore(
    database: Database,
    files: Files,
    model: str,
    version: int,
    base: TorqueModel,
    at_most: int | None = None,
    pages: int | None = None,
) -> RestoredState:
    """Return the learnt state of a version, up to event `at_most` if given.

    base: the version as trained. pages: max pages of the log that are learnt after the snapshot.
    """
    known = _load_base(database, files, model, version, base, at_most)
    while pages is None or pages > 0:
        following = advance(database, files, known, at_most)
        if following is known:
            break
        known, pages = following, None if pages is None else pages - 1
    return known


def advance(
    database: Database,
    files: Files,
    known: RestoredState,
    at_most: int | None = None,
    novel: NovelRowsCallback | None = None,
) -> RestoredState:
    """Return the state after the next page of events; the very same object if nothing is new.

    The result is an earlier state if events in this one have been undone. It is a later snapshot if the log lacks
    events that the snapshot contains. novel: see `OnlineModel.learn`.
    """
    model = known.model
    with database.session() as session:
        newest = log.newest(session, model)
        last = newest if at_most is None else min(at_most, newest)
        if last <= known.number:
            return known
        begin = undo.must_fold_again(session, model, known.version, known.seen, known.number)
        events, end = _page(session, known, last)
        if not begin and not known.torn and not log.is_complete(session, model, known.number, end):
            row = snapshots.find_latest(session, model, known.version, at_most)
            begin = row is not None and row.number > known.number
    if begin:
        return _load_base(database, files, model, known.version, known.online.base, at_most)
    online = _fold_events(known.online, events, novel)
    return replace(known, online=online, number=end, seen=newest)


def _load_base(
    database: Database, files: Files, model: str, version: int, base: TorqueModel, at_most: int | None
) -> RestoredState:
    """Load the newest readable snapshot, up to event `at_most` if given, else start from the version as trained."""
    limit, torn = at_most, False
    with database.session() as session:
        start, seen = log.start_of(session, model, version), log.newest(session, model)
        while (row := snapshots.find_latest(session, model, version, limit)) is not None:
            try:
                online = state.load(base, snapshots.read(files, row))
                return RestoredState(model, version, start, online, row.number, seen, torn)
            except (ValueError, OSError) as error:
                logger.error("snapshot %s of version %d of model %r cannot be used: %s", row.id, version, model, error)
                limit, torn = row.number - 1, True
        return replace(start_state(session, model, version, base), seen=seen, torn=torn)


def start_state(session: Session, model: str, version: int, base: TorqueModel) -> RestoredState:
    """Return the state of a version as trained, with the time constants that apply then."""
    start = log.start_of(session, model, version)
    online = _with_memory(OnlineModel.start(base), log.memory(session, model, start))
    return RestoredState(model, version, start, online, start, start)


def fold_page(database: Database, known: RestoredState, last: int) -> RestoredState:
    """Return the state after the next page of the events that are in the log, up to number `last`."""
    with database.session() as session:
        events, end = _page(session, known, last)
    return replace(known, online=_fold_events(known.online, events, None), number=end)


def _page(session: Session, known: RestoredState, last: int) -> tuple[Sequence[EventRow], int]:
    """Return the events to learn next, up to number `last`, and the number of the state that results."""
    part = {"model": known.model, "after": known.number, "through": last}
    sizes = list(fetch(session, _SIZES, **part).scalars())
    count = _count_page(sizes)
    events = session.scalars(_EVENTS, {**part, "count": count}).all()
    return events, last if count == len(sizes) < PAGE_EVENTS else events[-1].number


def _count_page(sizes: Iterable[int]) -> int:
    """Return how many of the next events, with these numbers of rows, make a page."""
    count, total = 0, 0
    for rows in sizes:
        if count and total + rows > PAGE_ROWS:
            break
        count, total = count + 1, total + rows
    return count


def _fold_events(online: OnlineModel, events: Sequence[EventRow], novel: NovelRowsCallback | None) -> OnlineModel:
    """Apply the events of a page to the online model, in order."""
    rows = {event.number: log.learning_rows(event) for event in events if event.payload is not None}
    teaches = any(len(each.learnt) for each in rows.values())
    online = online.detached() if teaches else online
    for event in events:
        if event.kind == "batch":
            online = online.begin(event.received if event.clock is None else event.clock)
        if event.number in rows:
            online = online.learn(rows[event.number], own=True, novel=novel)
        elif event.kind == "change":
            online = online.change(float(log.learning_time(event, (event.detail or {})["t"])))
        elif event.kind == "settings":
            online = _with_memory(online, Memory.from_json(event.detail or {}))
    return online.symmetrised() if teaches else online


def _with_memory(online: OnlineModel, memory: Memory) -> OnlineModel:
    """Return the model with these time constants for all later events."""
    return online.with_forgetting(memory.forgetting_s).with_walk(memory.friction_walk_s)
