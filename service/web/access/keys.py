"""API keys as they are stored: what a key may do and until when, and the sha256 of it, never the key itself."""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from hashlib import sha256
from math import inf

from sqlalchemy import select, update

from service.foundation.errors import InvalidRequestError
from service.foundation.names import for_people
from service.storage.database import ApiKeyRow, Database, now
from service.storage.files import new_id
from service.web.access.scopes import ADMIN, SCOPES

PREFIX = "lip_"
SECRET_BYTES = 32


@dataclass(slots=True, eq=False)
class Key:
    """A stored key, as it is checked. Times are Unix times in s.

    digest: sha256 of the key; expires: inf where it never does; seen: when it last let a request through, 0 where it
    has not since the start.
    """

    id: str
    digest: bytes
    scopes: frozenset[str]
    expires: float
    revoked: bool
    seen: float = field(default=0.0)

    def allows(self, scope: str) -> bool:
        """Whether the key may do what needs this scope."""
        return scope in self.scopes or ADMIN in self.scopes

    def valid(self, at: float) -> bool:
        """Whether the key is neither revoked nor expired at a Unix time."""
        return not self.revoked and at < self.expires


def digest_of(secret: bytes) -> bytes:
    """What of a key is stored and compared. A plain hash is enough: a key is 256 random bits, no password."""
    return sha256(secret).digest()


def create(database: Database, name: str, scopes: Iterable[str], expires_at: datetime | None) -> tuple[ApiKeyRow, str]:
    """Store a new key; return its row and the key, which nobody can tell again. Raise ValueError for wrong values."""
    try:
        for_people("name", name)
    except InvalidRequestError as error:
        raise ValueError(error.message) from error
    wanted = list(dict.fromkeys(scopes))
    if not wanted:
        raise ValueError(f"scopes are missing, expected some of {', '.join(SCOPES)}")
    for scope in wanted:
        if scope not in SCOPES:
            raise ValueError(f"scope is {scope!r}, expected one of {', '.join(SCOPES)}")
    secret = PREFIX + secrets.token_urlsafe(SECRET_BYTES)
    row = ApiKeyRow(
        id=new_id("key"),
        name=name,
        hash=digest_of(secret.encode()).hex(),
        scopes=wanted,
        created_at=now(),
        expires_at=None if expires_at is None else expires_at.astimezone(UTC).isoformat(timespec="milliseconds"),
    )
    with database.transaction() as session:
        session.add(row)
    return row, secret


def stored(database: Database) -> list[ApiKeyRow]:
    """Return all keys, the oldest first, also those that are no longer valid."""
    with database.session() as session:
        return list(session.scalars(select(ApiKeyRow).order_by(ApiKeyRow.seq)))


def revoke(database: Database, key: str) -> ApiKeyRow:
    """End a key for good, by its id; one that has been revoked stays as it is. Raise ValueError for an unknown id."""
    with database.transaction() as session:
        row = session.scalar(select(ApiKeyRow).where(ApiKeyRow.id == key))
        if row is None:
            raise ValueError(f"key is {key!r}, expected the id of a key: `lipserve keys list` shows them")
        row.revoked_at = row.revoked_at or now()
    return row


def note_used(database: Database, seen: Mapping[str, float]) -> None:
    """Store when keys, by id, were seen last: Unix times in s."""
    with database.transaction() as session:
        for key, at in seen.items():
            text = datetime.fromtimestamp(at, UTC).isoformat(timespec="milliseconds")
            session.execute(update(ApiKeyRow).where(ApiKeyRow.id == key).values(used_at=text))


def key_of(row: ApiKeyRow) -> Key:
    """Return a stored key as it is checked."""
    expires = inf if row.expires_at is None else datetime.fromisoformat(row.expires_at).timestamp()
    return Key(row.id, bytes.fromhex(row.hash), frozenset(row.scopes), expires, row.revoked_at is not None)


def state_of(row: ApiKeyRow, at: float) -> str:
    """Say in a word whether a key is `valid`, `expired` or `revoked` at a Unix time."""
    if row.revoked_at is not None:
        return "revoked"
    return "valid" if key_of(row).valid(at) else "expired"
