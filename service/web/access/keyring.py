"""The keys in memory: checked without the database, and read again every second for what another process changed."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from hmac import compare_digest
from time import time

from anyio import CapacityLimiter, to_thread

from service.foundation.errors import UnauthorizedError
from service.storage.database import ApiKeyRow, Database
from service.web.access import keys
from service.web.access.keys import Key, digest_of

logger = logging.getLogger(__name__)

INDEXED = 16
"""Bytes of a digest that keys are looked up by; the others are compared in constant time."""
NOTE_SECONDS = 60.0
"""How exactly it is stored when a key was seen last."""
CHALLENGE = 'Bearer realm="lipserve"'


class Keyring:
    """The keys of one service, for its event loop. Empty until `watching`.

    refresh_s: seconds after which a key that was made or revoked elsewhere is known here.
    """

    def __init__(self, refresh_s: float) -> None:
        self._refresh_s = refresh_s
        self._keys: dict[bytes, Key] = {}
        self._lasting: dict[Key, list[Callable[[], None]]] = {}
        self._noted: dict[str, float] = {}
        self._failing = False
        self._thread = CapacityLimiter(1)  # of its own: a revocation does not wait for requests that hold all others

    def find(self, secret: bytes | None) -> Key:
        """Return the key that a request carries, valid or not; raise UnauthorizedError where it carries none."""
        if secret is None:
            said = "no API key was given, expected the header `Authorization: Bearer lip_…` (clients: LIPSERVE_KEY)"
            raise UnauthorizedError(said, headers={"WWW-Authenticate": CHALLENGE})
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
        self._take(await to_thread.run_sync(keys.stored, database, limiter=self._thread))
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
            await self._note_used(database, NOTE_SECONDS)

    async def _refresh(self, database: Database) -> None:
        """Read the keys; while the database cannot be read, the known ones stay: controllers are not to stop for it."""
        try:
            rows = await to_thread.run_sync(keys.stored, database, limiter=self._thread)
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
            read = keys.key_of(row)
            key = known.pop(read.id, read)  # the same object: streams and counts hold on to it
            key.scopes, key.expires, key.revoked = read.scopes, read.expires, read.revoked
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
            await to_thread.run_sync(keys.note_used, database, seen, limiter=self._thread)
        except Exception as error:
            logger.warning("when keys were used cannot be stored: %s", error)
        self._noted |= seen


def refusal(said: str) -> UnauthorizedError:
    """Return the answer to a key that cannot be used."""
    return UnauthorizedError(said, headers={"WWW-Authenticate": f'{CHALLENGE}, error="invalid_token"'})
