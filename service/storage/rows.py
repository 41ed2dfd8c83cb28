"""Pages of rows for lists {items, next_cursor}, and idempotent requests.

A client names a request with the header `Idempotency-Key`. Key and digest of the request are columns of the row that
the request creates. So they are as durable as the row, and are deleted with it.
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
from service.telemetry.logs import KEY_ID, request_scope

MAX_PAGE = 100
"""Max items of one page of a list."""
DEFAULT_PAGE = 50
"""Items of a page, if the client names no number."""
Row = TypeVar("Row", AlarmRow, AuditRow, DatasetRow, EventRow, JobRow, ModelRow, RobotRow)


class Page(BaseModel):
    """A part of a list: at most `limit` items after `after`, newest first; from the newest if `after` is None."""

    after: int | None
    limit: int


def read_page(
    session: Session, table: type[Row], page: Page, *conditions: ColumnElement[bool]
) -> tuple[list[Row], str | None]:
    """Return the rows of a page that meet all conditions, newest first, and the next cursor, None on the last page."""
    query = select(table).where(*conditions).order_by(table.seq.desc()).limit(page.limit + 1)
    if page.after is not None:
        query = query.where(table.seq < page.after)
    rows = list(session.scalars(query))
    following = str(rows[page.limit - 1].seq) if len(rows) > page.limit else None
    return rows[: page.limit], following


HEADER = "Idempotency-Key"
Made = TypeVar("Made", DatasetRow, JobRow)


@dataclass(frozen=True)
class RequestIdentity:
    """The key of a request, and the digest of its content. stored: the key as the database has it."""

    key: str
    stored: str
    digest: str


def identify_request(key: str | None, *content: Any, file: Path | None = None) -> RequestIdentity | None:
    """Return the identity of the current request, None without a key. Each API key has keys of its own.

    content: JSON of the request. file: the uploaded file.
    """
    if key is None:
        return None
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode())
    if file is not None:
        with file.open("rb") as opened:
            digest.update(hashlib.file_digest(opened, "sha256").digest())
    client = (request_scope.get() or {}).get(KEY_ID)
    stored = key if client is None else hashlib.sha256(f"{client} {key}".encode()).hexdigest()
    return RequestIdentity(key, stored, digest.hexdigest())


def find_done_row(session: Session, table: type[Made], named: RequestIdentity | None) -> Made | None:
    """Return the row that the same request created before, None if there is none.

    Raise ConflictError if another request used the key. Inside a transaction no other request can create the row.
    """
    if named is None:
        return None
    row = session.scalar(select(table).where(table.idempotency_key == named.stored))
    if row is not None and row.request_digest != named.digest:
        raise ConflictError(
            f"{HEADER} {named.key} was used by another request, which made {row.id}: use a new key for each request",
            [problem(HEADER, named.key, "a key that no other request has used")],
        )
    return row


def mark_row(row: DatasetRow | JobRow, named: RequestIdentity | None) -> None:
    """Write the identity of the request into the row that it creates."""
    if named is not None:
        row.idempotency_key, row.request_digest = named.stored, named.digest
