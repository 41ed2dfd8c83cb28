"""API keys with scopes and expiry. Only the sha256 of a key is stored, never the key itself.

Keys are checked in memory and read from the database every second, since other processes can change them.
"""

from __future__ import annotations

import asyncio
import logging
import re
import secrets
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from hmac import compare_digest
from math import ceil, inf
from time import monotonic, time

from anyio import CapacityLimiter, to_thread
from sqlalchemy import select, update

from service.api.access.scopes import ADMIN, SCOPES
from service.api.limits.rates import Buckets, Rate
from service.foundation.errors import InvalidRequestError, RateLimitedError, UnauthorizedError
from service.foundation.fields import check_name
from service.storage.database import ApiKeyRow, Database, iso_time, now
from service.storage.files import new_id
from service.telemetry.counters import Counters

PREFIX = "lip_"
MIN_REQUESTS_PER_S, MAX_REQUESTS_PER_S = 1e-3, 1e6
"""Allowed range of the rate limit of a key, requests per s."""
IMPORTED_KEY = re.compile(rf"{PREFIX}[A-Za-z0-9_-]{{43,200}}")
"""Pattern of an imported key: at least 43 base64 characters, which hold 32 bytes like our own keys."""
REFRESH_S = 1.0
"""Interval at which a running service reads keys that other processes created or revoked."""


class KeyRate:
    """Rate limit of one key, in requests per s; `burst`: max requests at once of any client of the service."""

    __slots__ = ("_rate", "per_s")

    def __init__(self, per_s: float, burst: int, buckets: Buckets) -> None:
        self.per_s = per_s
        burst = max(1, min(burst, ceil(10.0 * per_s)))  # at most 10 s of its own rate at once
        self._rate = Rate(per_s, burst, buckets)

    def count(self, key: str) -> None:
        """Count a request of the key; raise RateLimitedError if it exceeds the rate."""
        if wait := self._rate.wait((KeyRate, key), monotonic()):
            message = f"Too many requests with API key {key}: at most {self.per_s:g} per s."
            raise RateLimitedError(message, headers={"Retry-After": str(ceil(wait))})


@dataclass(frozen=True)
class KeyRecord:
    """A stored key, as the fields of `Key` and its own rate limit, requests per s, say."""

    id: str
    digest: bytes
    scopes: frozenset[str]
    expires: float
    revoked: bool
    max_requests_per_s: float | None

    @classmethod
    def of(cls, row: ApiKeyRow) -> KeyRecord:
        """Return the record of a database row."""
        expires = inf if row.expires_at is None else datetime.fromisoformat(row.expires_at).timestamp()
        digest, revoked = bytes.fromhex(row.hash), row.revoked_at is not None
        return cls(row.id, digest, frozenset(row.scopes), expires, revoked, row.max_requests_per_s)


@dataclass(slots=True, eq=False)
class Key:
    """A stored key in memory. Times are Unix times in s.

    `digest` is the key's sha256, `expires` is inf for a key without expiry, and `rate` is its own limit, if any.
    """

    id: str
    digest: bytes
    scopes: frozenset[str]
    expires: float
    revoked: bool
    rate: KeyRate | None = None

    def allows(self, scope: str) -> bool:
        """Return whether the key has a scope, directly or through `admin`."""
        return scope in self.scopes or ADMIN in self.scopes

    def valid(self, at: float) -> bool:
        """Return whether the key is neither revoked nor expired at a Unix time."""
        return not self.revoked and at < self.expires


def digest_of(secret: bytes) -> bytes:
    """Return the sha256 of a key. A plain hash is enough, as a key has 256 random bits, unlike a password."""
    return sha256(secret).digest()


def create(
    database: Database,
    name: str,
    scopes: Iterable[str],
    expires_at: datetime | None,
    given: str | None = None,
    max_requests_per_s: float | None = None,
) -> tuple[ApiKeyRow, str]:
    """Store a new key; return its row and the key, which cannot be read again. Raise ValueError for wrong values.

    `given` is an imported key; if it is stored already, revoked or not, it stays unchanged. `max_requests_per_s`
    replaces the setting of this name.
    """
    try:
        check_name("name", name)
    except InvalidRequestError as error:
        raise ValueError(error.message) from error
    allowed = list(dict.fromkeys(scopes))
    if not allowed:
        raise ValueError(f"give at least one scope of {', '.join(SCOPES)}")
    for scope in allowed:
        if scope not in SCOPES:
            raise ValueError(f"scope is {scope!r}, expected one of {', '.join(SCOPES)}")
    if given is not None and not IMPORTED_KEY.fullmatch(given):
        raise ValueError(f"a key must be {PREFIX} followed by 43 to 200 random letters, digits, - or _")
    if max_requests_per_s is not None and not MIN_REQUESTS_PER_S <= max_requests_per_s <= MAX_REQUESTS_PER_S:
        raise ValueError(
            f"rate is {max_requests_per_s:g}, expected {MIN_REQUESTS_PER_S:g} to {MAX_REQUESTS_PER_S:g} requests per s"
        )
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


def list_keys(database: Database) -> list[ApiKeyRow]:
    """Return all keys, oldest first, including invalid ones."""
    with database.session() as session:
        return list(session.scalars(select(ApiKeyRow).order_by(ApiKeyRow.seq)))


def revoke(database: Database, key: str) -> ApiKeyRow:
    """Revoke a key by its id, permanently. A revoked key stays unchanged. Raise ValueError for an unknown id."""
    with database.transaction() as session:
        row = session.scalar(select(ApiKeyRow).where(ApiKeyRow.id == key))
        if row is None:
            raise ValueError(f"there is no key {key!r}: `lipserve keys list` shows the ids of all keys")
        row.revoked_at = row.revoked_at or now()
    return row


def note_used(database: Database, seen: Mapping[str, float]) -> None:
    """Store the last use of keys: Unix times in s by key id."""
    with database.transaction() as session:
        for key, at in seen.items():
            session.execute(update(ApiKeyRow).where(ApiKeyRow.id == key).values(used_at=iso_time(at)))


def key_of(record: KeyRecord) -> Key:
    """Return the key of a record."""
    return Key(record.id, record.digest, record.scopes, record.expires, record.revoked)


def state_of(row: ApiKeyRow, at: float) -> str:
    """Return `valid`, `expired` or `revoked`, the state of a key at a Unix time."""
    if row.revoked_at is not None:
        return "revoked"
    return "valid" if key_of(KeyRecord.of(row)).valid(at) else "expired"


logger = logging.getLogger(__name__)

PREFIX_BYTES = 16
"""Leading bytes of a digest that keys are looked up by. The whole digest is then compared in constant time."""
_KEY = "key"
"""Kind of the counters with the time of the last request that a key authorised, Unix time in s."""
CHALLENGE = 'Bearer realm="lipserve"'


class Keyring:
    """The keys of one service, for its event loop. Empty until `watching` or `update`.

    `refresh_s` is the interval between reads of the database. `burst` limits the requests at once of a key with its own
    rate, which are counted in `buckets`. `counters` have the last use of each key. `records` are the keys as last
    read.
    """

    def __init__(
        self, refresh_s: float, burst: int, counters: Counters | None = None, buckets: Buckets | None = None
    ) -> None:
        self._refresh_s, self._burst = refresh_s, burst
        self.records: tuple[KeyRecord, ...] = ()
        self.when_changed: list[Callable[[], None]] = []
        """Functions called after the keys have changed."""
        self._counters = Counters() if counters is None else counters
        self._buckets = Buckets() if buckets is None else buckets
        self._keys: dict[bytes, Key] = {}
        self._lasting: dict[Key, list[Callable[[], None]]] = {}
        self._noted: dict[str, float] = {}
        self._failing = False
        self._thread = CapacityLimiter(1)  # its own: a revocation must not wait for requests that use all other threads

    def find(self, secret: bytes | None) -> Key:
        """Return the key of a request, valid or not; raise UnauthorizedError for a missing or unknown key."""
        if secret is None:
            message = (
                "An API key is required. Send the header `Authorization: Bearer lip_…` (clients: set LIPSERVE_API_KEY)."
            )
            raise UnauthorizedError(message, headers={"WWW-Authenticate": CHALLENGE})
        digest = digest_of(secret)
        key = self._keys.get(digest[:PREFIX_BYTES])
        if key is None or not compare_digest(key.digest, digest):
            raise invalid_key("Unknown API key.")
        return key

    def use(self, key: Key) -> None:
        """Record a use of a key; raise UnauthorizedError if it is no longer valid."""
        at = time()
        if not key.valid(at):
            raise invalid_key(f"API key {key.id} {'was revoked' if key.revoked else 'has expired'}.")
        self._counters.tally(_KEY, key.id).reals[0] = at

    @contextmanager
    def lasting(self, key: Key, end: Callable[[], None]) -> Iterator[None]:
        """Call `end`, possibly more than once, if the key becomes invalid while the context is open."""
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
        """Read the keys now and then regularly while the context is open."""
        self.update(await to_thread.run_sync(_read_records, database, limiter=self._thread))
        valid = sum(key.valid(time()) for key in self._keys.values())
        if valid:
            logger.info("API keys are required; %d valid", valid)
        else:
            logger.warning("API keys are required, but none is valid: create one with `lipserve keys create`")
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
        """Read the keys. If the database fails, keep the known keys, so that controllers continue."""
        try:
            records = await to_thread.run_sync(_read_records, database, limiter=self._thread)
        except Exception as error:
            if not self._failing:
                logger.warning("API keys cannot be read; the known ones stay valid: %s", error)
            self._failing = True
        else:
            self._failing = False
            self.update(records)
        self.end_lasting()

    def update(self, records: tuple[KeyRecord, ...]) -> None:
        """Replace the keys. Streams of a key that is revoked last until `end_lasting`."""
        if records == self.records:
            return
        known = {key.id: key for key in self._keys.values()}
        fresh: dict[bytes, Key] = {}
        for record in records:
            key = known.pop(record.id, None) or key_of(record)  # the same object, which streams and rates refer to
            key.scopes, key.expires, key.revoked = record.scopes, record.expires, record.revoked
            if record.max_requests_per_s is not None and key.rate is None:
                key.rate = KeyRate(record.max_requests_per_s, self._burst, self._buckets)
            fresh[key.digest[:PREFIX_BYTES]] = key
        for gone in known.values():
            gone.revoked = True
        self._keys, self.records = fresh, records
        for call in self.when_changed:
            call()

    def end_lasting(self) -> None:
        """End the streams of keys that are revoked or expired. Use it in the event loop, once a second."""
        at = time()
        for key in [key for key in self._lasting if not key.valid(at)]:
            ends = list(self._lasting[key])
            logger.info("API key %s is no longer valid: closing its streams (%d)", key.id, len(ends))
            for end in ends:
                try:
                    end()
                except Exception:  # still close the others
                    logger.exception("a stream of API key %s could not be closed", key.id)

    async def _note_used(self, database: Database, seconds: float) -> None:
        """Store the last use of keys that were used more than `seconds` after the stored use."""
        last = {key: max(each.reals[0] for each in tallies) for (key,), tallies in self._counters.tallies(_KEY).items()}
        seen = {key: at for key, at in last.items() if at > self._noted.get(key, 0.0) + seconds}
        if not seen:
            return
        try:
            await to_thread.run_sync(note_used, database, seen, limiter=self._thread)
        except Exception as error:
            logger.warning("the last use of API keys could not be stored: %s", error)
        self._noted |= seen


def _read_records(database: Database) -> tuple[KeyRecord, ...]:
    return tuple(map(KeyRecord.of, list_keys(database)))


def invalid_key(message: str) -> UnauthorizedError:
    """Return the error for a key that cannot be used."""
    return UnauthorizedError(message, headers={"WWW-Authenticate": f'{CHALLENGE}, error="invalid_token"'})
