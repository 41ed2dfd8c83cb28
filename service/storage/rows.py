"""What routes make of rows: pages of lists, {items, next_cursor}; and requests that may be sent again, done once.

A client names a request by the header `Idempotency-Key`. Key and digest of the request are columns of the row that it
makes: they are as durable as what was done, and go with it when it is deleted.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel
from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session

from service.foundation.errors import ConflictError, problem
from service.storage.database import AlarmRow, AuditRow, DatasetRow, EventRow, JobRow, ModelRow, RobotRow
from service.telemetry.logs import KEY_ID, asked

MAX_PAGE = 100
"""Items of one page of a list, at most."""
USUAL = 50
Row = TypeVar("Row", AlarmRow, AuditRow, DatasetRow, EventRow, JobRow, ModelRow, RobotRow)


class Page(BaseModel):
    """Which part of a list: items after `after`, at most `limit`, newest first where `after` is None."""

    after: int | None
    limit: int


def newest(
    session: Session, table: type[Row], page: Page, *conditions: ColumnElement[bool]
) -> tuple[list[Row], str | None]:
    """Return the rows of a page that meet all conditions, newest first, and the cursor after it, None on the last."""
    query = select(table).where(*conditions).order_by(table.seq.desc()).limit(page.limit + 1)
    if page.after is not None:
        query = query.where(table.seq < page.after)
    rows = list(session.scalars(query))
    following = str(rows[page.limit - 1].seq) if len(rows) > page.limit else None
    return rows[: page.limit], following


HEADER = "Idempotency-Key"
Made = TypeVar("Made", DatasetRow, JobRow)


@dataclass(frozen=True)
class Identity:
    """A request as its client names it, and the digest of what it says. stored: the name as the database has it."""

    key: str
    stored: str
    digest: str


def identity(key: str | None, *content: Any, file: Path | None = None) -> Identity | None:
    """The identity of the request that is being answered; None where it has no key. content: JSON of what it asks;
    file: what it brings. Each API key has names of its own."""
    if key is None:
        return None
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode())
    if file is not None:
        with file.open("rb") as opened:
            digest.update(hashlib.file_digest(opened, "sha256").digest())
    client = (asked.get() or {}).get(KEY_ID)
    stored = key if client is None else hashlib.sha256(f"{client} {key}".encode()).hexdigest()
    return Identity(key, stored, digest.hexdigest())


def done(session: Session, table: type[Made], named: Identity | None) -> Made | None:
    """The row that a request has made before; None where it has not. Raise ConflictError where another request has the
    key. Inside a transaction nobody else can make one meanwhile."""
    if named is None:
        return None
    row = session.scalar(select(table).where(table.idempotency_key == named.stored))
    if row is not None and row.request_digest != named.digest:
        raise ConflictError(
            f"{HEADER} is {named.key}, the key of another request, which made {row.id}: give every request its own",
            [problem(HEADER, named.key, "a key that no other request was sent with")],
        )
    return row


def mark(row: DatasetRow | JobRow, named: Identity | None) -> None:
    """Write the identity of the request into the row that it makes."""
    if named is not None:
        row.idempotency_key, row.request_digest = named.stored, named.digest
