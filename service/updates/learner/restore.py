"""What a version has learnt, made from its last snapshot and the log of events since.

The state after event number k is a function of the log, whoever makes it and in however many steps: the version as
trained, and all batches with start < number <= k that teach, less those that were unlearnt or rolled back since. It is
made one page of the log at a time, so that what comes of it can be published in between.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sqlalchemy import select
from sqlalchemy.orm import Session, undefer

from lipcore.model import TorqueModel
from lipcore.online import state
from lipcore.online.batch import Rows
from lipcore.online.learner import ForgottenError, OnlineModel
from service.database import Database, EventRow
from service.files import Files
from service.updates.storage import log, snapshots
from service.updates.storage.payload import decode

logger = logging.getLogger(__name__)

PAGE_ROWS = 500
"""Rows that are learnt in one step, unless a single batch has more: about 0.4 s for a robot of seven joints."""
PAGE_EVENTS = 200


@dataclass(frozen=True)
class Restored:
    """What a version had learnt after event `number`.

    seen: newest event that was looked at: no rollback up to it is left to be followed; taken: newest unlearning that is
    accounted for, which may be an event beyond `number`.
    """

    model: str
    version: int
    online: OnlineModel
    number: int
    seen: int
    taken: int

    @property
    def settled(self) -> bool:
        """Whether the state is that of the log up to `number` and of nothing later, so that it can be stored."""
        return self.taken <= self.number and self.online.since is not None


@dataclass(frozen=True)
class Arrival:
    """A batch, or a replay of one, that is about to be learnt."""

    event: EventRow
    rows: Rows


Watch = Callable[[Sequence[Arrival]], None]


class RewoundError(Exception):
    """The state cannot be changed into what the log now says: make it anew, from a snapshot up to event `number`."""

    def __init__(self, number: int) -> None:
        super().__init__(f"the state has to be made anew from event {number} or earlier")
        self.number = number


def restore(
    database: Database,
    files: Files,
    model: str,
    version: int,
    base: TorqueModel,
    at_most: int | None = None,
    *,
    rewound_to: int | None = None,
    most_rows: int | None = None,
) -> Restored:
    """Return what a version has learnt, after event `at_most` where given. base: the version as trained.

    rewound_to: begin with a snapshot up to this number; most_rows: stop after the page that reaches so many rows.
    """
    rows = 0

    def count(arrivals: Sequence[Arrival]) -> None:
        nonlocal rows
        rows += sum(len(each.rows) for each in arrivals)

    known = _begin(database, files, model, version, base, _least(at_most, rewound_to))
    while most_rows is None or rows < most_rows:
        try:
            following = advance(database, known, at_most, count)
        except RewoundError as error:
            rewound_to = _least(error.number, rewound_to)
            following = _begin(database, files, model, version, base, _least(at_most, rewound_to))
        if following is known:
            break
        known = following
    return known


def advance(database: Database, known: Restored, at_most: int | None = None, watch: Watch | None = None) -> Restored:
    """Return the state after the next page of events, the very same one where nothing is new.

    watch: is told the batches of the page before they are learnt. Raise RewoundError.
    """
    with database.session() as session:
        page = _Page.read(session, known, at_most)
        rolled_back = [to for to, number in page.rollbacks if number > known.seen and to < known.number]
        if rolled_back:
            raise RewoundError(min(rolled_back))
        unlearnt = _unlearnt(session, known, page)
        events = log.events(session, known.model, known.number, page.count, void=True) if page.count else []
    if not events and not unlearnt:
        return known
    events = [each for each in events if each.number <= page.end and not page.is_void(each)]
    if known.online.since is None and any(each.kind == "batch" for each in events):
        raise RewoundError(known.number)  # from when on the training is forgotten, the first batch tells
    arrivals = [Arrival(each, decode(each.payload)) for each in events if each.payload is not None]
    if watch is not None:
        watch(arrivals)
    online = _learn(_unlearn(database, known, unlearnt), events, {each.event.number: each.rows for each in arrivals})
    taken = max([known.taken, *page.unlearnings.values()])
    return Restored(known.model, known.version, online, page.end, page.seen, taken)


@dataclass(frozen=True)
class _Page:
    """The next `count` events, up to number `end`, and what events up to `seen`, later ones too, say about others.

    unlearnings: number of the unlearning by that of its batch; rollbacks: where each leads, and its own number.
    """

    end: int
    count: int
    seen: int
    unlearnings: dict[int, int]
    rollbacks: list[tuple[int, int]]

    @classmethod
    def read(cls, session: Session, known: Restored, at_most: int | None) -> _Page:
        newest = log.newest(session, known.model)  # first: what is committed meanwhile is seen now or the next time
        later = (EventRow.model == known.model, EventRow.number > known.number)
        last = newest if at_most is None else min(at_most, newest)
        upcoming = select(EventRow.number, EventRow.rows).where(*later, EventRow.number <= last)
        end, count, total = known.number, 0, 0
        for number, rows in session.execute(upcoming.order_by(EventRow.number).limit(PAGE_EVENTS)):
            if count and total + rows > PAGE_ROWS:
                break
            end, count, total = number, count + 1, total + rows
        kinds = EventRow.kind.in_(("unlearn", "rollback"))
        found = session.execute(select(EventRow.number, EventRow.kind, EventRow.detail).where(*later, kinds)).all()
        unlearnings = {each.detail["event"]: each.number for each in found if each.kind == "unlearn"}
        rollbacks = [(each.detail["to"], each.number) for each in found if each.kind == "rollback"]
        return cls(end, count, max([newest, *(each.number for each in found)]), unlearnings, rollbacks)

    def is_void(self, event: EventRow) -> bool:
        """Whether an event of this page has been taken out since."""
        batch = _batch(event) if event.kind == "replay" else event.number
        return batch in self.unlearnings or any(to < event.number < number for to, number in self.rollbacks)


def _begin(
    database: Database, files: Files, model: str, version: int, base: TorqueModel, at_most: int | None
) -> Restored:
    """The newest snapshot that can be read, up to a number where given, or the version as trained."""
    with database.session() as session:
        seen = log.newest(session, model)  # first: of the rollbacks up to it, a snapshot that is still there knows
        start = log.start_of(session, model, version)
        while (row := snapshots.latest(session, model, version, at_most)) is not None:
            try:
                online = state.load(base, snapshots.read(files, row))
                return Restored(model, version, online, row.number, max(seen, row.number), row.number)
            except (ValueError, OSError) as error:
                logger.error("snapshot %s of version %d of model %r cannot be used: %s", row.id, version, model, error)
                at_most = row.number - 1
        first = select(EventRow.received).where(
            EventRow.model == model, EventRow.number > start, EventRow.kind == "batch"
        )
        since = session.scalar(first.order_by(EventRow.number).limit(1))
        online = OnlineModel.start(base, log.forgetting(session, model, start), since)
    return Restored(model, version, online, start, max(seen, start), start)


def _unlearnt(session: Session, known: Restored, page: _Page) -> list[EventRow]:
    """The batches, and their replays, that the state contains and an unlearning takes out of it."""
    start = log.start_of(session, known.model, known.version)
    found: list[EventRow] = []
    for batch, unlearning in sorted(page.unlearnings.items()):
        if unlearning <= known.taken or not start < batch <= known.number:
            continue
        others = EventRow.kind.in_(("replay", "unlearn", "rollback"))
        since = (EventRow.model == known.model, EventRow.number >= batch, (EventRow.number == batch) | others)
        rows = list(session.scalars(select(EventRow).where(*since).options(undefer(EventRow.payload))))
        if any(row.kind == "unlearn" and _batch(row) == batch and row.number <= known.taken for row in rows):
            continue  # more than once is once
        spans = [range(row.detail["to"] + 1, row.number) for row in rows if row.kind == "rollback" and row.detail]
        contained = [row for row in rows if row.number <= known.number and row.payload is not None]
        contained = [row for row in contained if batch in (row.number, _batch(row))]
        found += [row for row in contained if not any(row.number in span for span in spans)]
    return found


def _unlearn(database: Database, known: Restored, events: list[EventRow]) -> OnlineModel:
    """The state without these batches; raise RewoundError where it takes the log to tell what they have left behind."""
    if not events:
        return known.online
    try:
        oldest = min(each.number for each in events)
        with database.session() as session:
            reweighed = select(EventRow.number).where(
                EventRow.model == known.model,
                EventRow.number > oldest,
                EventRow.number <= known.number,
                EventRow.kind == "settings",
                EventRow.void.is_(False),
            )
            if session.scalar(reweighed.limit(1)) is not None:
                raise ForgottenError("forgetting has changed since")
        online = known.online
        for event in events:
            online = online.unlearn(decode(event.payload or b""))
        return online
    except ForgottenError as error:
        if _can_restore(database, known, oldest - 1):
            raise RewoundError(oldest - 1) from error
        numbers = ", ".join(str(each.number) for each in events)
        logger.error("events %s of model %r stay in what is learnt: %s", numbers, known.model, error)
        return known.online


def _can_restore(database: Database, known: Restored, at_most: int) -> bool:
    """Whether the log reaches from a snapshot up to a number, or from the version as trained, to the state."""
    with database.session() as session:
        row = snapshots.latest(session, known.model, known.version, at_most)
        begin = log.start_of(session, known.model, known.version) if row is None else row.number
        return log.is_complete(session, known.model, begin, known.number)


def _learn(online: OnlineModel, events: Sequence[EventRow], rows: dict[int, Rows]) -> OnlineModel:
    """Take in events in order; batches between two others together."""
    waiting: list[Rows] = []
    for event in events:
        if event.number in rows:
            waiting.append(rows[event.number])
        elif event.kind in ("change", "settings"):
            online = _learn_rows(online, waiting)
            waiting = []
            detail = event.detail or {}
            online = (
                online.change(detail["t"]) if event.kind == "change" else online.with_forgetting(detail["forgetting_s"])
            )
    return _learn_rows(online, waiting)


def _learn_rows(online: OnlineModel, parts: Sequence[Rows]) -> OnlineModel:
    return online.learn(Rows.concatenate(parts)) if parts else online


def _batch(event: EventRow) -> int | None:
    """Number of the batch that a replay or an unlearning is about."""
    return (event.detail or {}).get("event")


def _least(one: int | None, other: int | None) -> int | None:
    return min((each for each in (one, other) if each is not None), default=None)
