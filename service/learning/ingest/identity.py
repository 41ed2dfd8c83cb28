"""Whether a batch has come before: by its stream and sequence, and by a digest of its content."""

from __future__ import annotations

import hashlib
from struct import pack

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from service.foundation.errors import ConflictError
from service.journal import log
from service.learning.errors import ExpiredError
from service.learning.ingest.parsing import Measured
from service.learning.schema import ObservationResponse, State
from service.storage.database import EventRow


def digest(rows: Measured) -> str:
    """Sha256 over shapes and numbers: equal for equal content, whatever JSON or joint order it came in."""
    found = hashlib.sha256(pack("<2Q", *rows.q.shape))
    for values in (rows.t, rows.q, rows.dq, rows.ddq, rows.tau):
        found.update(b"-" if values is None else b"+")
        if values is not None:
            # one zero and one NaN of the several that there are
            canonical = np.where(np.isnan(values), np.nan, values + 0.0)
            found.update(canonical.astype("<f8").tobytes())
    return found.hexdigest()


def known(session: Session, model: str, stream_id: str, sequence: int, content: str) -> ObservationResponse | None:
    """What was said of a batch when it came first, with what has become of it; None for one that is new.

    Raise ConflictError for another content of the same identity, ExpiredError where that cannot be known any more.
    """
    event = log.find_batch(session, model, stream_id, sequence)
    if event is None:
        check_kept(session, model, stream_id, sequence)
        return None
    if event.digest != content:
        raise ConflictError(
            f"batch {sequence} of stream {stream_id!r} has come before with other content: a sequence is used once"
        )
    return ObservationResponse.model_validate(
        {**(event.report or {}), "duplicate": True, "state": state(session, event)}
    )


def check_kept(session: Session, model: str, stream_id: str, sequence: int) -> None:
    """Raise ExpiredError where a batch that is not in the log may have been there."""
    source = log.stream(session, model, stream_id)
    if source is not None and log.is_forgotten(source, sequence):
        raise ExpiredError(
            f"it is not known any more whether batch {sequence} of stream {stream_id!r} has come before: batches up to "
            f"{source.forgotten} are no longer kept"
        )


def state(session: Session, event: EventRow) -> State:
    """What has become of a batch since it came."""
    if not event.void:
        return "learnt"
    query = select(EventRow.seq).where(
        EventRow.model == event.model,
        EventRow.number > event.number,
        EventRow.kind == "unlearn",
        EventRow.detail["event"].as_integer() == event.number,
    )
    return "rolled_back" if session.scalar(query.limit(1)) is None else "unlearnt"
