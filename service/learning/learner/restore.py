"""What a version has learnt, made from its last snapshot and the log of events since.

The state after event number k is a function of the log up to k, to the last bit, whoever makes it, when, from which
snapshot and in however many steps; so services that share a log answer alike. It is folded event by event, ((s + e1)
+ e2) + …, in the order of their numbers:

* a batch, or a replay, is learnt by itself at its place, even where it is unlearnt later;
* unlearning subtracts it again, at the place of the unlearning. Where it cannot be subtracted, since two changes,
  another time constant or many epochs of friction have come in between, the log is learnt anew from the state before
  it, without it and without all else that is unlearnt on the way (`course.left_out`);
* a rollback leads to the state after the event that it names, less what was unlearnt between that and the rollback.
  Events that it undoes are passed over where that is known before they are learnt.

It holds for as long as the log has what is needed. Where `snapshots.retain` has deleted it, the newest snapshot is
gone on from, whoever stored it; without one, what is left of the log is learnt, and a batch that only the log could
take out stays in what is learnt. It also takes the same arithmetic: the same release, kind of processor and number
of threads.

Pages of the log are bounded, so that what comes of one can be published, and others have their turn, in between.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from lipcore.model.torque_model import TorqueModel
from lipcore.online import transfer as state
from lipcore.online.batch import Rows
from lipcore.online.learner import ForgottenError, Novel, OnlineModel
from service.journal import log, snapshots
from service.journal.log import Memory
from service.learning.learner import course
from service.learning.learner.course import RewoundError, Stretch, Taking, batch_of
from service.storage.database import Database, EventRow
from service.storage.files import Files

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Restored:
    """What a version has learnt after event `number`. start: the event that it contains by training.

    without: batches that are left out, each up to the number of an event (see `course.left_out`); torn: whether the
    newest snapshot could not be read, so that nothing is to be waited for where the log has gaps.
    """

    model: str
    version: int
    start: int
    online: OnlineModel
    number: int
    without: Mapping[int, int] = field(default_factory=dict)
    torn: bool = False

    @property
    def settled(self) -> bool:
        """Whether this is the state of the log up to `number`, and not a stage on the way to a later event."""
        return not any(batch <= self.number < until for batch, until in self.without.items())


@dataclass(frozen=True)
class Arrival:
    """A batch, or a replay of one, that is about to be learnt."""

    event: EventRow
    rows: Rows


Watch = Callable[[Sequence[Arrival]], None]


def restore(
    database: Database,
    files: Files,
    model: str,
    version: int,
    base: TorqueModel,
    at_most: int | None = None,
    *,
    rewound: RewoundError | None = None,
    most_rows: int | None = None,
    taken_back: bool = False,
) -> Restored:
    """Return what a version has learnt, after event `at_most` where given. base: the version as trained.

    rewound: begin where this says; most_rows: stop after the page that reaches so many rows, with the last state that
    is settled; taken_back: take out what has been unlearnt since event `at_most`, too.
    """
    rows = 0

    def count(arrivals: Sequence[Arrival]) -> None:
        nonlocal rows
        rows += sum(len(each.rows) for each in arrivals)

    known = settled = _begin(database, files, model, version, base, at_most, rewound)
    while most_rows is None or rows < most_rows:
        try:
            following = advance(database, known, at_most, count)
            if following is known and taken_back and at_most is not None:
                return _without_later(database, known)
        except RewoundError as error:
            following = _begin(database, files, model, version, base, at_most, error)
        if following is known:
            break
        known = following
        settled = known if known.settled else settled
    return settled


def advance(
    database: Database,
    known: Restored,
    at_most: int | None = None,
    watch: Watch | None = None,
    novel: Novel | None = None,
) -> Restored:
    """Return the state after the next page of events, the very same one where nothing is new. watch: called with the
    batches of the page before they are learnt; novel: see `OnlineModel.learn`. Raise RewoundError."""
    with database.session() as session:
        newest = log.newest(session, known.model)
        last = newest if at_most is None else min(at_most, newest)
        if last <= known.number:
            return known
        part = course.ahead(session, known.model, known.start, known.number, last)
        if not part.complete and not known.torn and _has_newer(database, known, at_most):
            raise RewoundError(None)
    if part.is_rollback and any(until < part.end for until in _active(known).values()):
        raise RewoundError(known.number)  # a batch was left out for the sake of events that are undone
    events = [each for each in part.events if not _is_left_out(known, each)]
    arrivals = [Arrival(each, log.learning_rows(each)) for each in events if each.payload is not None]
    if watch is not None and arrivals:
        watch(arrivals)
    teaches = any(len(each.rows.learnt) for each in arrivals) or any(each.events for each in part.takings.values())
    online = known.online.detached() if teaches else known.online
    if part.is_rollback:
        for taking in part.takings.values():
            online = _take(database, known, online, taking, part.end)
        online = online if part.memory is None else _remembering(online, part.memory)
    else:
        rows = {each.event.number: each.rows for each in arrivals}
        online = _learn(database, known, online, part, rows, novel)
    online = online.symmetrised() if teaches else online
    return replace(known, online=online, number=part.end, without=_active(replace(known, number=part.end)))


def _begin(
    database: Database,
    files: Files,
    model: str,
    version: int,
    base: TorqueModel,
    at_most: int | None,
    rewound: RewoundError | None,
) -> Restored:
    """The newest snapshot that can be read, up to a number where given, or the version as trained."""
    without = {} if rewound is None else rewound.without
    limits = [each for each in (at_most, None if rewound is None else rewound.number) if each is not None]
    limit, torn = min(limits, default=None), False
    with database.session() as session:
        start = log.start_of(session, model, version)
        while (row := snapshots.latest(session, model, version, limit)) is not None:
            try:
                online = state.load(base, snapshots.read(files, row))
                return Restored(model, version, start, online, row.number, without, torn)
            except (ValueError, OSError) as error:
                logger.error("snapshot %s of version %d of model %r cannot be used: %s", row.id, version, model, error)
                limit, torn = row.number - 1, True
        online = _remembering(OnlineModel.start(base), course.in_force(session, model, start))
    return Restored(model, version, start, online, start, without, torn)


def _learn(
    database: Database,
    known: Restored,
    online: OnlineModel,
    part: Stretch,
    rows: Mapping[int, Rows],
    novel: Novel | None,
) -> OnlineModel:
    """Take in the events of a page, one after the other. online: one whose sums nobody else has, where any teaches."""
    for event in part.events:
        if event.kind == "batch":
            online = online.begin(event.received if event.clock is None else event.clock)
        if event.number in rows:
            online = online.learn(rows[event.number], own=True, novel=novel)
        elif event.kind == "unlearn":
            online = _take(database, known, online, part.takings[event.number], event.number)
        elif event.kind == "change":
            online = online.change(float(log.learning_time(event, (event.detail or {})["t"])))
        elif event.kind == "settings":
            online = _remembering(online, Memory.from_json(event.detail or {}))
    return online


def _remembering(online: OnlineModel, memory: Memory) -> OnlineModel:
    """What has been learnt, remembered otherwise from here on."""
    return online.with_forgetting(memory.forgetting_s).with_walk(memory.friction_walk_s)


def _take(database: Database, known: Restored, online: OnlineModel, taking: Taking, end: int) -> OnlineModel:
    """Take a batch and its replays out again, for the sake of event `end`; raise RewoundError where that takes the log.
    online: one whose sums nobody else has."""
    if _is_without(known, taking.batch, taking.number) or not taking.events:
        return online
    try:
        if taking.reweighed:
            raise ForgottenError("a time constant has changed since")
        every = [log.learning_rows(each) for each in taking.events]
        for rows in every:
            online.check_unlearn(rows)
        for rows in every:
            online = online.unlearn(rows, own=True)
        return online
    except ForgottenError as error:
        with database.session() as session:
            without = _active(known) | course.left_out(session, known.model, known.start, taking.batch, end)
            oldest = min(without)
            row = snapshots.latest(session, known.model, known.version, oldest - 1)
            begin = known.start if row is None else row.number
            complete = log.is_complete(session, known.model, begin, end - 1)
        if complete:
            raise RewoundError(oldest - 1, without) from error
        if not known.torn and _has_newer(database, known, None):
            raise RewoundError(None) from error
        numbers = ", ".join(str(each.number) for each in taking.events)
        logger.error("events %s of model %r stay in what is learnt: %s", numbers, known.model, error)
        return online


def _without_later(database: Database, known: Restored) -> Restored:
    """A state less what has been unlearnt since; raise RewoundError."""
    with database.session() as session:
        newest = log.newest(session, known.model)
        takings = course.takings_since(session, known.model, known.start, known.number, newest + 1)
    online = known.online.detached()
    for taking in takings:
        online = _take(database, known, online, taking, newest + 1)
    return replace(known, online=online.symmetrised(), without={}) if takings else known


def _has_newer(database: Database, known: Restored, at_most: int | None) -> bool:
    """Whether there is a snapshot that goes beyond a state."""
    with database.session() as session:
        row = snapshots.latest(session, known.model, known.version, at_most)
    return row is not None and row.number > known.number


def _active(known: Restored) -> dict[int, int]:
    """What is still left out."""
    return {batch: until for batch, until in known.without.items() if until > known.number}


def _is_without(known: Restored, batch: int, number: int) -> bool:
    """Whether a batch is left out up to an event."""
    return number <= known.without.get(batch, 0)


def _is_left_out(known: Restored, event: EventRow) -> bool:
    return event.kind in ("batch", "replay") and _is_without(known, batch_of(event), event.number)
