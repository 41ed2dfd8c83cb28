"""Requests that may be sent again: a client names one by the header `Idempotency-Key`, and it is done once.

Key and digest of the request are columns of the row that the request makes: they are as durable as what was done, and
go with it when it is deleted.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

from fastapi import Header
from sqlalchemy import select
from sqlalchemy.orm import Session

from service.foundation.errors import ConflictError, problem
from service.storage.database import DatasetRow, JobRow

HEADER = "Idempotency-Key"
Row = TypeVar("Row", DatasetRow, JobRow)

KeyHeader = Annotated[
    str | None,
    Header(
        alias=HEADER,
        max_length=100,
        pattern=r"^[!-~]+$",
        description="A name that the client gives to this request, of printable characters without spaces, so that it "
        "can send it again when the answer is lost: it is done once, and what it made is answered each time. Another "
        "request under the same key is a conflict",
    ),
]


@dataclass(frozen=True)
class Identity:
    """A request as its client names it, and the digest of what it says."""

    key: str
    digest: str


def identity(key: str | None, *content: Any, file: Path | None = None) -> Identity | None:
    """The identity of a request; None where it has no key. content: JSON of what it asks; file: what it brings."""
    if key is None:
        return None
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode())
    if file is not None:
        with file.open("rb") as opened:
            digest.update(hashlib.file_digest(opened, "sha256").digest())
    return Identity(key, digest.hexdigest())


def done(session: Session, table: type[Row], named: Identity | None) -> Row | None:
    """The row that a request has made before; None where it has not. Raise ConflictError where another request has the
    key. Inside a transaction nobody else can make one meanwhile."""
    if named is None:
        return None
    row = session.scalar(select(table).where(table.idempotency_key == named.key))
    if row is not None and row.request_digest != named.digest:
        raise ConflictError(
            f"{HEADER} is {named.key}, the key of another request, which made {row.id}: give every request its own",
            [problem(HEADER, named.key, "a key that no other request was sent with")],
        )
    return row


def mark(row: DatasetRow | JobRow, named: Identity | None) -> None:
    """Write the identity of the request into the row that it makes."""
    if named is not None:
        row.idempotency_key, row.request_digest = named.key, named.digest
