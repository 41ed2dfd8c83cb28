"""Data of a refresh: the logged rows and data sets that still describe the robot."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from lipcore.data.motion import spaced_rows
from lipcore.data.samples import Array, Samples
from lipcore.online.batch import Rows
from service.journal import log
from service.journal.log import decode
from service.storage.database import Database, DatasetRow, EventRow

MAX_AGE_FORGETTING_TIMES = 5.0
"""Maximum age of a sample in forgetting times; an older one would have a weight below one per cent."""


@dataclass(frozen=True)
class Scope:
    """Rows that a refresh learns from: of the log up to event `through`, with an event time of at least `since`."""

    through: int
    """Number of the last event."""
    since: float
    """Earliest event time, Unix s."""
    newest: float | None
    """Latest event time of the log, Unix s; None without rows."""
    forgetting_s: float | None
    """Time constant of forgetting, s; None if nothing is forgotten."""
    changed: float | None
    """Event time of the last change of the robot, Unix s. Earlier data describe another robot."""

    def left_out(self, recorded: DatasetRow) -> str | None:
        """Return why a data set is not learnt, None if it is. Its age counts from its upload."""
        if self.changed is not None:
            return "the robot has changed since"
        if datetime.fromisoformat(recorded.created_at).timestamp() < self.since:
            return f"it is older than {MAX_AGE_FORGETTING_TIMES:g} times the forgetting time"
        return None


def scope_of(session: Session, model: str, through: int) -> Scope:
    """Return the current scope of the log up to an event."""
    live = (EventRow.model == model, EventRow.number <= through, EventRow.void.is_(False))
    newest = session.scalar(select(func.max(EventRow.last)).where(*live, EventRow.learnt > 0))
    details = session.scalars(select(EventRow.detail).where(*live, EventRow.kind == "change"))
    changed = max((float((detail or {})["t"]) for detail in details), default=None)
    forgetting_s = log.memory(session, model, through).forgetting_s
    since = -math.inf if changed is None else changed
    if forgetting_s is not None and newest is not None:
        since = max(since, newest - MAX_AGE_FORGETTING_TIMES * forgetting_s)
    return Scope(through, since, newest, forgetting_s, changed)


def rows_within(session: Session, model: str, scope: Scope) -> int:
    """Return the number of logged rows in scope, or up to one batch more, as only whole batches are counted."""
    live = (EventRow.model == model, EventRow.number <= scope.through, EventRow.void.is_(False))
    return session.scalar(select(func.sum(EventRow.learnt)).where(*live, EventRow.last >= scope.since)) or 0


def split_datasets(
    session: Session, scope: Scope, lineage: dict[str, Any]
) -> tuple[list[DatasetRow], list[dict[str, str]]]:
    """Return the data sets of a lineage that a refresh learns from, in order, and why others are left out."""
    named = [item["id"] for item in lineage.get("datasets", [])]
    known = datasets(session, named)
    kept, left_out = [], []
    for name in named:
        why = scope.left_out(known[name]) if name in known else "it has been deleted"
        if why is None:
            kept.append(known[name])
        else:
            left_out.append({"id": name, "reason": why})
    return kept, left_out


def is_taken_back(session: Session, model: str, through: int, after: int) -> bool:
    """Return whether an event after number `after` unlearnt or rolled back anything up to event `through`."""
    later = (EventRow.model == model, EventRow.number > after)
    undone = select(EventRow.kind, EventRow.detail).where(*later, EventRow.kind.in_(("unlearn", "rollback")))
    return any(
        detail["event"] <= through if kind == "unlearn" else detail["to"] < through
        for kind, detail in session.execute(undone)
    )


def datasets(session: Session, names: Collection[str]) -> dict[str, DatasetRow]:
    """Return the existing data sets among `names`, by id."""
    return {row.id: row for row in session.scalars(select(DatasetRow).where(DatasetRow.id.in_(names)))}


PAGE = 50
"""Events per read."""
COMPARED_SHARE = 1 / 3
"""Share of the rows in scope, the newest, on which a refreshed version is compared before it learns them."""


@dataclass(frozen=True)
class ComparisonRows:
    """Logged rows after event `after`; neither the judged fit nor the version as of that event has learnt them."""

    after: int
    samples: Samples


def newest_part(session: Session, model: str, scope: Scope, start: int) -> int:
    """Return the event after which the newest COMPARED_SHARE of the rows in scope lie, at least event `start`."""
    live = (EventRow.model == model, EventRow.number <= scope.through, EventRow.void.is_(False), EventRow.learnt > 0)
    query = select(EventRow.number, EventRow.learnt).where(*live, EventRow.last >= scope.since)
    counts = session.execute(query.order_by(EventRow.number.desc())).all()
    left = COMPARED_SHARE * sum(learnt for _, learnt in counts)
    for number, learnt in counts:
        left -= learnt
        if left <= 0:
            return max(number - 1, start)
    return scope.through


@dataclass(frozen=True)
class LoggedSamples:
    """Samples of the log with event times as t, None if there are none. `rows` is their number before thinning."""

    samples: Samples | None
    rows: int


def read_log(
    database: Database,
    model: str,
    joint_names: tuple[str, ...],
    scope: Scope,
    most: int,
    longest_step: float,
    after: int = 0,
) -> LoggedSamples:
    """Return the logged rows in scope that can be learnt, from events after number `after`, thinned evenly to `most`.

    They are sorted by stream and time. A new episode begins if the time steps by more than `longest_step` seconds.
    """
    kept, count = _thinned(database, model, scope, most, after)
    if count == 0:
        return LoggedSamples(None, 0)
    rows, source = Rows.concatenate([part for part, _ in kept]), np.concatenate([stream for _, stream in kept])
    order = np.lexsort((rows.time, source))
    rows, source = rows.take(order), source[order]
    breaks = (np.diff(source) != 0) | (np.diff(rows.time) > longest_step)
    episode = np.concatenate([[0], np.cumsum(breaks)]).astype(np.int64)
    found = Samples(joint_names, rows.time, episode, rows.q, rows.dq, rows.ddq, rows.tau, rows.deflections)
    return LoggedSamples(found, count)


def age_weights(times: Array, scope: Scope) -> Array | None:
    """Return the weights exp(−age/forgetting_s) of samples, (N,); None if nothing is forgotten. times: Unix s."""
    if scope.forgetting_s is None or scope.newest is None:
        return None
    return np.exp(np.minimum(times - scope.newest, 0.0) / scope.forgetting_s)


def _thinned(
    database: Database, model: str, scope: Scope, most: int, after: int
) -> tuple[list[tuple[Rows, Array]], int]:
    """Return every k-th row in scope in log order with its stream's number, and the number of rows in scope.

    One pass with at most 2·`most` rows in memory: k doubles each time that limit is reached.
    """
    kept: list[tuple[Rows, Array]] = []
    streams: dict[str | None, int] = {}
    step, count, held = 1, 0, 0
    while True:
        with database.session() as session:
            events = log.events(session, model, after, PAGE)
        for event in events:
            if event.number > scope.through or event.payload is None:
                continue
            rows = decode(event.payload).learnt
            rows = rows.take(rows.time >= scope.since)
            chosen = rows.take((np.arange(count, count + len(rows)) % step) == 0)
            count, held = count + len(rows), held + len(chosen)
            kept.append((chosen, np.full(len(chosen), streams.setdefault(event.stream_id, len(streams)))))
            if held > 2 * most:
                kept, step = _where(kept, np.arange(held) % 2 == 0), 2 * step
                held = sum(len(part) for part, _ in kept)
        if len(events) < PAGE or events[-1].number >= scope.through:
            break
        after = events[-1].number
    kept = [pair for pair in kept if len(pair[0])]
    if held > most:
        chosen_rows = np.zeros(held, dtype=bool)
        chosen_rows[spaced_rows(held, most)] = True
        kept = _where(kept, chosen_rows)
    return kept, count


def _where(parts: list[tuple[Rows, Array]], mask: NDArray[np.bool_]) -> list[tuple[Rows, Array]]:
    """Return the rows of all parts at which the mask is set."""
    out, at = [], 0
    for rows, stream in parts:
        chosen = mask[at : at + len(rows)]
        at += len(rows)
        out.append((rows.take(chosen), stream[chosen]))
    return out
