"""Helpers that write observation batches and other events into the log of a model."""

from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import select

from lipcore.online.batch import Rows
from lipcore.vocabulary import CODES
from service.foundation.settings import Settings
from service.journal import log, undo
from service.journal.arrivals import NewBatch
from service.storage.database import Database, EventRow, ModelRow, ServingRow, StreamRow, VersionRow, now

MODEL, OTHER = "arm", "other"


def open_database(home: Path) -> Database:
    """Return a database with two models, each of one version."""
    database = Database.of(Settings(home=home))
    with database.transaction() as session:
        session.add_all(ModelRow(name=name, created_at=now()) for name in (MODEL, OTHER))
        session.flush()
        for name in (MODEL, OTHER):
            session.add(ServingRow(model=name, version=1, change=1))
            session.add(VersionRow(model=name, version=1, folder=f"mv_{name}", created_at=now(), job=None, manifest={}))
    return database


def make_rows(count: int = 4, n: int = 2, seed: int = 0, codes: tuple[str, ...] = ()) -> Rows:
    """Return rows at 1 kHz from event time 100 s + seed; `codes` are those of the first rows, the others are learnt."""
    values = np.random.default_rng(seed).normal(size=(4, count, n))
    code = np.zeros(count, np.uint8)
    code[: len(codes)] = [CODES.index(name) for name in codes]
    return Rows(100.0 + seed + np.arange(count) / 1000, *values, code)


def make_batch(sequence: int, last: int | None = None, **fields: Any) -> NewBatch:
    """Return a batch, or frames if `last` is given; rows and digest depend on the sequence."""
    defaults = {
        "stream_id": "robot-1",
        "kind": "batches" if last is None else "frames",
        "sequence": sequence,
        "last_sequence": sequence if last is None else last,
        "digest": f"{sequence:064x}",
        "offset": 1.5,
        "received": 1000.0 + sequence,
        "version": 1,
        "revision": 0,
        "rows": make_rows(seed=sequence),
        "report": {"accepted": 4, "rejected": {}},
        "record": {"rows": 4},
    }
    return NewBatch(**{**defaults, **fields})


def list_events(database: Database, model: str = MODEL) -> list[EventRow]:
    """Return all events of a model by number."""
    with database.session() as session:
        return list(session.scalars(select(EventRow).where(EventRow.model == model).order_by(EventRow.number)))


def list_valid_numbers(database: Database, model: str = MODEL) -> list[int]:
    """Return the numbers of the events that are not void."""
    return [event.number for event in list_events(database, model) if not event.void]


def append_batches(database: Database, *batches: NewBatch, model: str = MODEL) -> list[int]:
    """Log each batch in its own transaction; return the event numbers."""
    numbers = []
    for item in batches:
        with database.transaction() as session:
            numbers.append(log.append_batch(session, model, item)[0].number)
    return numbers


def append_event(
    database: Database, kind: log.EventKind, detail: dict[str, Any], model: str = MODEL, **more: Any
) -> int:
    """Log an event that is not a batch; return its number."""
    with database.transaction() as session:
        return log.append(session, model, kind, detail, 2000.0, **more).number


def unlearn_batch(database: Database, number: int) -> int:
    """Unlearn the batch with this event number; return the number of the unlearn event."""
    with database.transaction() as session:
        [event] = log.events(session, MODEL, number - 1, 1, void=True)
        return undo.unlearn(session, MODEL, event, 3000.0).number


def roll_back(database: Database, to: int) -> int:
    """Roll back to an event; return the number of the rollback event."""
    with database.transaction() as session:
        return undo.rollback(session, MODEL, to, 3000.0).number


def find_stream(database: Database, stream_id: str = "robot-1", model: str = MODEL) -> StreamRow | None:
    """Return the stored row of a stream, or None."""
    with database.session() as session:
        return log.stream(session, model, stream_id)
