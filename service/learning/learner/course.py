"""Which events of a model's log are learnt next, which ones a rollback passes over, which ones an unlearning takes out.

All of it is a function of the events up to the one in question, whatever was logged later: the marks `void` of events,
which later ones set, are not read.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, bindparam, select
from sqlalchemy.orm import Session, defer, undefer

from service.journal import log
from service.journal.log import Memory
from service.storage.database import EventRow, fetch

PAGE_ROWS = 500
"""Rows that are learnt in one step, unless a single batch has more: for a robot of seven joints about 15 ms with the
learnt arm, and up to 0.4 s with an estimator of many inducing outputs."""
PAGE_EVENTS = 200

_PART = (
    EventRow.model == bindparam("model"),
    EventRow.number > bindparam("after"),
    EventRow.number <= bindparam("through"),
)
_ROLLBACKS = (
    select(EventRow.number, EventRow.detail).where(*_PART, EventRow.kind == "rollback").order_by(EventRow.number)
)
_SIZES = select(EventRow.rows).where(*_PART).order_by(EventRow.number).limit(PAGE_EVENTS)
_EVENTS = (  # what was answered and recorded of them is not learnt
    select(EventRow)
    .where(*_PART)
    .order_by(EventRow.number)
    .limit(bindparam("count"))
    .options(undefer(EventRow.payload), defer(EventRow.report), defer(EventRow.record))
)


@dataclass(frozen=True)
class Taking:
    """What an unlearning takes out: the batch and its replays, as far as they are learnt, in their order.

    number: its event; batch: the number of the batch; reweighed: whether a time constant was set otherwise in between,
    so that it is not known what the rows weigh by now.
    """

    number: int
    batch: int
    events: Sequence[EventRow]
    reweighed: bool


@dataclass(frozen=True)
class Stretch:
    """What follows an event: either the events that are learnt next, or a rollback that leads from it to `end`.

    takings: what is unlearnt in it, by the numbers of the unlearnings. memory: what a rollback to before the beginning
    of a version sets; None where nothing is set. complete: whether no event of it is missing.
    """

    end: int
    is_rollback: bool
    events: Sequence[EventRow]
    takings: Mapping[int, Taking]
    memory: Memory | None
    complete: bool


class RewoundError(Exception):
    """The state cannot be changed into that of the log: make it anew, from a snapshot up to event `number`.

    number: None for the newest snapshot of all. without: batches that are to be left out on the way, each with the
    number of the event before which that is so.
    """

    def __init__(self, number: int | None, without: Mapping[int, int] | None = None) -> None:
        super().__init__(f"the state has to be made anew from {'a snapshot' if number is None else f'event {number}'}")
        self.number, self.without = number, dict(without or {})


def ahead(session: Session, model: str, start: int, number: int, last: int) -> Stretch:
    """What follows event `number` up to `last` at most; start: that of the version. Raise RewoundError. Where a
    rollback leads back to this event, the stretch is that rollback: what it undoes is not learnt in vain."""
    rollbacks = _rollbacks(session, model, start, number, last)
    if earlier := [to for to, *_ in rollbacks if to < number]:
        raise RewoundError(min(earlier))
    here = [(end, target) for to, end, target in rollbacks if to == number]
    if here:
        end, target = max(here)
        takings = {each.number: each for each in takings_since(session, model, start, number, end)}
        memory = in_force(session, model, target) if target < start else None
        return Stretch(end, True, [], takings, memory, log.is_complete(session, model, number, end))
    stop = min([last, *(to for to, *_ in rollbacks)])
    part = {"model": model, "after": number, "through": stop}
    count = _count(fetch(session, _SIZES, **part).scalars())
    events = session.scalars(_EVENTS, {**part, "count": count}).all()
    end = events[-1].number if events else stop
    unlearnings = [each for each in events if each.kind == "unlearn"]
    takings = {each.number: _taking(session, each, start, each.number - 1) for each in unlearnings}
    return Stretch(end, False, events, takings, None, end - number == len(events))


def takings_since(session: Session, model: str, start: int, number: int, end: int) -> list[Taking]:
    """What the unlearnings after event `number`, before `end`, take out of its state."""
    query = select(EventRow).where(*_span(model, number, end - 1), EventRow.kind == "unlearn")
    takings: dict[int, Taking] = {}
    for event in session.scalars(query.order_by(EventRow.number)):
        taking = _taking(session, event, start, number)
        takings.setdefault(taking.batch, taking)  # more than once is once
    return list(takings.values())


def left_out(session: Session, model: str, start: int, batch: int, end: int) -> dict[int, int]:
    """The batches to leave out where the log up to `end` is learnt anew without one; `end` by their numbers. Besides it
    those that are unlearnt on the way: then nothing is learnt that would have to be taken out again."""
    batches = {batch}
    while True:
        query = select(EventRow.detail).where(*_span(model, min(batches), end), EventRow.kind == "unlearn")
        more = {detail["event"] for detail in session.scalars(query) if detail["event"] > start} - batches
        if not more:
            return dict.fromkeys(batches, end)
        batches |= more


def in_force(session: Session, model: str, number: int) -> Memory:
    """What is set after event `number`."""
    query = select(EventRow.number, EventRow.detail).where(
        EventRow.model == model, EventRow.number <= number, EventRow.kind == "settings"
    )
    settings: dict[int, Any] = {row.number: row.detail for row in session.execute(query)}
    undone = _undone(session, model, min(settings, default=number), number)
    held = [at for at in settings if not any(at in each for each in undone)]
    return Memory.from_json(settings[max(held)]) if held else Memory()


def batch_of(event: EventRow) -> int:
    """Number of the batch that an event learns or unlearns: its own where it is one."""
    return event.number if event.kind == "batch" else int((event.detail or {})["event"])


def _rollbacks(session: Session, model: str, start: int, number: int, last: int) -> list[tuple[int, int, int]]:
    """Rollbacks after an event: where each leads on the log that is left by then, its own number, the one it names."""
    rollbacks: list[tuple[int, int, int]] = []
    for row in fetch(session, _ROLLBACKS, model=model, after=number, through=last):
        own, detail = row.number, row.detail
        to = max(detail["to"], start)
        for before, until, _ in rollbacks:
            to = before if before < to < until else to
        rollbacks.append((to, own, detail["to"]))
    return rollbacks


def _count(sizes: Iterable[int]) -> int:
    """How many events of so many rows each make the next page."""
    count, total = 0, 0
    for rows in sizes:
        if count and total + rows > PAGE_ROWS:
            break
        count, total = count + 1, total + rows
    return count


def _taking(session: Session, unlearning: EventRow, start: int, through: int) -> Taking:
    """What an unlearning takes out of the state after event `through`, which may be one long before it."""
    model, batch = unlearning.model, batch_of(unlearning)
    about = (EventRow.detail["event"].as_integer() == batch) & EventRow.kind.in_(("replay", "unlearn"))
    query = select(EventRow.number, EventRow.kind, EventRow.detail).where(
        *_span(model, batch - 1, unlearning.number - 1),
        (EventRow.number == batch) | (EventRow.kind == "rollback") | about,
    )
    learnt: list[int] = []
    if batch > start:
        for number, kind, detail in session.execute(query.order_by(EventRow.number)):
            if kind == "unlearn":
                learnt = []
            elif kind == "rollback":
                learnt = [each for each in learnt if each <= detail["to"]]
            elif number <= through:
                learnt.append(number)
    chosen = select(EventRow).where(EventRow.model == model, EventRow.number.in_(learnt)).order_by(EventRow.number)
    events = list(session.scalars(chosen.options(undefer(EventRow.payload)))) if learnt else []
    return Taking(unlearning.number, batch, events, bool(learnt) and _is_reweighed(session, model, learnt[0], through))


def _is_reweighed(session: Session, model: str, number: int, through: int) -> bool:
    """Whether a time constant was set between two events."""
    query = select(EventRow.number).where(*_span(model, number, through), EventRow.kind == "settings")
    undone = _undone(session, model, number, through)
    return any(not any(at in each for each in undone) for at in session.scalars(query))


def _undone(session: Session, model: str, number: int, through: int) -> list[range]:
    """The events that rollbacks between two events have undone."""
    rollbacks = fetch(session, _ROLLBACKS, model=model, after=number, through=through)
    return [range(each.detail["to"] + 1, each.number) for each in rollbacks]


def _span(model: str, after: int, through: int) -> tuple[ColumnElement[bool], ...]:
    return EventRow.model == model, EventRow.number > after, EventRow.number <= through
