"""API keys: what a key may do and until when, with the sha256 of it, never the key itself.

They are checked in memory, without the database, and read again every second for what another process changed.
"""

from __future__ import annotations

import asyncio
import logging
import re
import secrets
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from hashlib import sha256
from hmac import compare_digest
from math import ceil, inf
from time import monotonic, time

from anyio import CapacityLimiter, to_thread
from sqlalchemy import select, update

from service.api.access.scopes import ADMIN, SCOPES
from service.api.limits.requests import Rate
from service.foundation.errors import InvalidRequestError, RateLimitedError, UnauthorizedError
from service.foundation.fields import check_name
from service.storage.database import ApiKeyRow, Database, now
from service.storage.files import new_id

PREFIX = "lip_"
SLOWEST, FASTEST = 1e-3, 1e6
"""Requests per s that a key may be limited to."""
GIVEN = re.compile(rf"{PREFIX}[A-Za-z0-9_-]{{43,200}}")
"""A key that was made elsewhere: 43 letters of base64 are the 32 bytes of ours."""
REFRESH_S = 1.0
"""Seconds after which a running service knows of keys that another process made or revoked."""


class KeyRate:
    """How often one key may ask, per s, as it was made; burst: most at once, of any client of the service."""

    __slots__ = ("_rate", "per_s")

    def __init__(self, per_s: float, burst: int) -> None:
        self.per_s = per_s
        self._rate = Rate(per_s, max(1, min(burst, ceil(10.0 * per_s))))  # at most 10 s of its own rate at once

    def count(self, key: str) -> None:
        """Count a request of the key; raise RateLimitedError where it comes too early."""
        if wait := self._rate.wait(key, monotonic()):
            message = f"the API key {key} asks more than {self.per_s:g} times per s, the most that it may"
            raise RateLimitedError(message, headers={"Retry-After": str(ceil(wait))})


@dataclass(slots=True, eq=False)
class Key:
    """A stored key, as it is checked. Times are Unix times in s.

    digest: sha256 of the key; expires: inf where it never does; rate: of its own, None where it has none; seen: when it
    last let a request through, 0 where it has not since the start.
    """

    id: str
    digest: bytes
    scopes: frozenset[str]
    expires: float
    revoked: bool
    rate: KeyRate | None = None
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


def create(
    database: Database,
    name: str,
    scopes: Iterable[str],
    expires_at: datetime | None,
    given: str | None = None,
    max_requests_per_s: float | None = None,
) -> tuple[ApiKeyRow, str]:
    """Store a new key; return its row and the key, which nobody can tell again. Raise ValueError for wrong values.

    given: a key that was made elsewhere. One that is stored already, revoked or not, stays as it is.
    max_requests_per_s: how often it may ask, instead of what the setting of this name says.
    """
    try:
        check_name("name", name)
    except InvalidRequestError as error:
        raise ValueError(error.message) from error
    allowed = list(dict.fromkeys(scopes))
    if not allowed:
        raise ValueError(f"scopes are missing, expected some of {', '.join(SCOPES)}")
    for scope in allowed:
        if scope not in SCOPES:
            raise ValueError(f"scope is {scope!r}, expected one of {', '.join(SCOPES)}")
    if given is not None and not GIVEN.fullmatch(given):
        raise ValueError(f"the key is not one, expected {PREFIX} and 43 to 200 random letters, digits, - or _")
    if max_requests_per_s is not None and not SLOWEST <= max_requests_per_s <= FASTEST:
        raise ValueError(f"rate is {max_requests_per_s:g}, expected {SLOWEST:g} to {FASTEST:g} requests per s")
    secret = given or PREFIX + secrets.token_urlsafe(32)
    row = ApiKeyRow(
        id=new_id("key"),
        name=name,
        hash=digest_of(secret.encode()).hex(),
        scopes=allowed,
        created_at=now(),
        expires_at=None if expires_at is None else expires_at.astimezone(UTC).isoformat(timespec="milliseconds"),
    )
    row.max_requests_per_s = max_requests_per_s
    with database.transaction() as session:
        if given is not None:
            known = session.scalar(select(ApiKeyRow).where(ApiKeyRow.hash == row.hash))
            if known is not None:
                return known, secret
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


logger = logging.getLogger(__name__)

INDEXED = 16
"""Bytes of a digest that keys are looked up by; the others are compared in constant time."""
CHALLENGE = 'Bearer realm="lipserve"'


class Keyring:
    """The keys of one service, for its event loop. Empty until `watching`.

    refresh_s: seconds after which a key that was made or revoked elsewhere is known here; burst: most requests at once
    of a key that has a rate of its own.
    """

    def __init__(self, refresh_s: float, burst: int) -> None:
        self._refresh_s, self._burst = refresh_s, burst
        self._keys: dict[bytes, Key] = {}
        self._lasting: dict[Key, list[Callable[[], None]]] = {}
        self._noted: dict[str, float] = {}
        self._failing = False
        self._thread = CapacityLimiter(1)  # of its own: a revocation does not wait for requests that hold all others

    def find(self, secret: bytes | None) -> Key:
        """Return the key that a request carries, valid or not; raise UnauthorizedError where it carries none."""
        if secret is None:
            message = (
                "no API key was given, expected the header `Authorization: Bearer lip_…` (clients: LIPSERVE_API_KEY)"
            )
            raise UnauthorizedError(message, headers={"WWW-Authenticate": CHALLENGE})
        digest = digest_of(secret)
        key = self._keys.get(digest[:INDEXED])
        if key is None or not compare_digest(key.digest, digest):
            raise refusal("the API key is not one of this service")
        return key

    def use(self, key: Key) -> None:
        """Let a key be used now; raise UnauthorizedError where it is no longer valid."""
        at = time()
        if not key.valid(at):
            raise refusal(f"the API key {key.id} {'was revoked' if key.revoked else 'has expired'}")
        key.seen = at

    @contextmanager
    def lasting(self, key: Key, end: Callable[[], None]) -> Iterator[None]:
        """Call `end`, which may be more than once, when the key is no longer valid while the context lasts."""
        ends = self._lasting.setdefault(key, [])
        ends.append(end)
        try:
            yield
        finally:
            ends.remove(end)
            if not ends:
                self._lasting.pop(key, None)

    @asynccontextmanager
    async def watching(self, database: Database) -> AsyncIterator[None]:
        """Read the keys, and again and again while the context lasts."""
        self._take(await to_thread.run_sync(stored, database, limiter=self._thread))
        valid = sum(key.valid(time()) for key in self._keys.values())
        if valid:
            logger.info("keys are needed, %d are valid", valid)
        else:
            logger.warning("keys are needed and none is valid: make one with `lipserve keys create`")
        task = asyncio.create_task(self._watch(database))
        try:
            yield
        finally:
            task.cancel()
            await asyncio.wait((task,))
            await self._note_used(database, 0.0)

    async def _watch(self, database: Database) -> None:
        while True:
            await asyncio.sleep(self._refresh_s)
            await self._refresh(database)
            await self._note_used(database, 60.0)

    async def _refresh(self, database: Database) -> None:
        """Read the keys; while the database cannot be read, the known ones stay: controllers are not to stop for it."""
        try:
            rows = await to_thread.run_sync(stored, database, limiter=self._thread)
        except Exception as error:
            if not self._failing:
                logger.warning("the keys cannot be read, those known stay as they are: %s", error)
            self._failing = True
        else:
            self._failing = False
            self._take(rows)
        self._end_lasting()

    def _take(self, rows: list[ApiKeyRow]) -> None:
        known = {key.id: key for key in self._keys.values()}
        fresh: dict[bytes, Key] = {}
        for row in rows:
            read = key_of(row)
            key = known.pop(read.id, read)  # the same object: streams and counts hold on to it
            key.scopes, key.expires, key.revoked = read.scopes, read.expires, read.revoked
            if row.max_requests_per_s is not None and key.rate is None:
                key.rate = KeyRate(row.max_requests_per_s, self._burst)
            fresh[key.digest[:INDEXED]] = key
        for gone in known.values():
            gone.revoked = True
        self._keys = fresh

    def _end_lasting(self) -> None:
        at = time()
        for key in [key for key in self._lasting if not key.valid(at)]:
            ends = list(self._lasting[key])
            logger.info("%d streams end with the key %s", len(ends), key.id)
            for end in ends:
                try:
                    end()
                except Exception:  # the others are to end all the same
                    logger.exception("a stream of the key %s cannot be ended", key.id)

    async def _note_used(self, database: Database, seconds: float) -> None:
        """Store when keys were seen last, of those that were seen so long after what is stored."""
        seen = {key.id: key.seen for key in self._keys.values() if key.seen > self._noted.get(key.id, 0.0) + seconds}
        if not seen:
            return
        try:
            await to_thread.run_sync(note_used, database, seen, limiter=self._thread)
        except Exception as error:
            logger.warning("when keys were used cannot be stored: %s", error)
        self._noted |= seen


def refusal(message: str) -> UnauthorizedError:
    """Return the answer to a key that cannot be used."""
    return UnauthorizedError(message, headers={"WWW-Authenticate": f'{CHALLENGE}, error="invalid_token"'})
