"""What a version has learnt: its newest snapshot, and the events of the log since, folded one after the other.

The state after event k is the fold of the events up to k that are not void. To undo is to mark events void, in the
transaction that logs it, which deletes the snapshots that contain them too; whoever holds a state that contains them
folds the log again, from the newest snapshot that is left. So the state is a function of the log, to the last bit,
whoever makes it, when, and in however many steps: services that share a log answer alike. (It takes the same
arithmetic: the same release, kind of processor and number of threads.)

It holds for as long as the log has what is needed. Where `snapshots.retain` has deleted events that a state lacks, the
newest snapshot is continued, whoever stored it; without one, what is left of the log is learnt. A batch stays in a
state that cannot be folded again without it.

Pages of the log are bounded, so that what comes of one can be published, and others have their turn, in between.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from sqlalchemy import bindparam, select
from sqlalchemy.orm import Session, defer, undefer

from lipcore.model.torque_model import TorqueModel
from lipcore.online import transfer as state
from lipcore.online.learner import Novel, OnlineModel
from service.journal import log, snapshots, undo
from service.journal.log import Memory
from service.storage.database import Database, EventRow, fetch
from service.storage.files import Files

logger = logging.getLogger(__name__)

PAGE_ROWS = 500
"""Rows that are learnt in one step, unless a single batch has more: for a robot of seven joints about 15 ms with the
learnt arm, and up to 0.4 s with an estimator of many inducing outputs."""
PAGE_EVENTS = 200

_LIVE = (
    EventRow.model == bindparam("model"),
    EventRow.number > bindparam("after"),
    EventRow.number <= bindparam("through"),
    EventRow.void.is_(False),
)
_SIZES = select(EventRow.rows).where(*_LIVE).order_by(EventRow.number).limit(PAGE_EVENTS)
_EVENTS = (  # what was answered and recorded of them is not learnt
    select(EventRow)
    .where(*_LIVE)
    .order_by(EventRow.number)
    .limit(bindparam("count"))
    .options(undefer(EventRow.payload), defer(EventRow.report), defer(EventRow.record))
)


@dataclass(frozen=True)
class Restored:
    """What a version has learnt after event `number`. start: the event that it contains by training.

    seen: number of the event up to which undoing is taken into account; torn: whether the newest snapshot could not be
    read, so that nothing is to be waited for where the log has gaps.
    """

    model: str
    version: int
    start: int
    online: OnlineModel
    number: int
    seen: int
    torn: bool = False


def restore(
    database: Database,
    files: Files,
    model: str,
    version: int,
    base: TorqueModel,
    at_most: int | None = None,
    pages: int | None = None,
) -> Restored:
    """Return what a version has learnt, after event `at_most` where given. base: the version as trained; pages: of the
    log since its snapshot that are learnt at most."""
    known = _begin(database, files, model, version, base, at_most)
    while pages is None or pages > 0:
        following = advance(database, files, known, at_most)
        if following is known:
            break
        known, pages = following, None if pages is None else pages - 1
    return known


def advance(
    database: Database, files: Files, known: Restored, at_most: int | None = None, novel: Novel | None = None
) -> Restored:
    """Return the state after the next page of events, the very same one where nothing is new. It is an earlier state
    where events that this one contains have been undone, or where the log lacks events that a later snapshot contains.
    novel: see `OnlineModel.learn`."""
    model = known.model
    with database.session() as session:
        newest = log.newest(session, model)
        last = newest if at_most is None else min(at_most, newest)
        if last <= known.number:
            return known
        begin = undo.must_fold_again(session, model, known.version, known.seen, known.number)
        events, end = _page(session, known, last)
        if not begin and not known.torn and not log.is_complete(session, model, known.number, end):
            row = snapshots.latest(session, model, known.version, at_most)
            begin = row is not None and row.number > known.number
    if begin:
        return _begin(database, files, model, known.version, known.online.base, at_most)
    online = _learn(known.online, events, novel)
    return replace(known, online=online, number=end, seen=newest)


def _begin(
    database: Database, files: Files, model: str, version: int, base: TorqueModel, at_most: int | None
) -> Restored:
    """The newest snapshot that can be read, up to a number where given, or the version as trained."""
    limit, torn = at_most, False
    with database.session() as session:
        start, seen = log.start_of(session, model, version), log.newest(session, model)
        while (row := snapshots.latest(session, model, version, limit)) is not None:
            try:
                online = state.load(base, snapshots.read(files, row))
                return Restored(model, version, start, online, row.number, seen, torn)
            except (ValueError, OSError) as error:
                logger.error("snapshot %s of version %d of model %r cannot be used: %s", row.id, version, model, error)
                limit, torn = row.number - 1, True
        online = _remembering(OnlineModel.start(base), log.memory(session, model, start))
    return Restored(model, version, start, online, start, seen, torn)


def _page(session: Session, known: Restored, last: int) -> tuple[Sequence[EventRow], int]:
    """The events to learn next, up to number `last` at most, and the number that they lead to."""
    part = {"model": known.model, "after": known.number, "through": last}
    sizes = list(fetch(session, _SIZES, **part).scalars())
    count = _count(sizes)
    events = session.scalars(_EVENTS, {**part, "count": count}).all()
    return events, last if count == len(sizes) < PAGE_EVENTS else events[-1].number


def _count(sizes: Iterable[int]) -> int:
    """How many events of so many rows each make the next page."""
    count, total = 0, 0
    for rows in sizes:
        if count and total + rows > PAGE_ROWS:
            break
        count, total = count + 1, total + rows
    return count


def _learn(online: OnlineModel, events: Sequence[EventRow], novel: Novel | None) -> OnlineModel:
    """Fold the events of a page, one after the other."""
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
            online = _remembering(online, Memory.from_json(event.detail or {}))
    return online.symmetrised() if teaches else online


def _remembering(online: OnlineModel, memory: Memory) -> OnlineModel:
    """What has been learnt, remembered otherwise from here on."""
    return online.with_forgetting(memory.forgetting_s).with_walk(memory.friction_walk_s)
