"""What failing storage means to a client: errors of the database and of the operating system as those of the service.

Nothing was stored where one of these comes: files are written whole or not at all, rows in transactions.
"""

from __future__ import annotations

import errno
import logging
import sqlite3

from fastapi import FastAPI, Request
from fastapi.responses import JSONResponse
from sqlalchemy.exc import DBAPIError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from service.errors import ServiceError, StorageFullError, StorageUnavailableError, answer_of

logger = logging.getLogger(__name__)

FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Of the operating system: the disk, a quota or the largest file allowed is used up."""
UNAVAILABLE = frozenset(
    getattr(errno, name)
    for name in ("EROFS", "EIO", "EACCES", "EPERM", "EMFILE", "ENFILE", "ENODEV", "ENXIO", "ESTALE", "ENOTCONN")
    if hasattr(errno, name)
)
RETRY_AFTER = {"Retry-After": "1"}
_BUSY = frozenset({sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED})
_DAMAGED = frozenset({sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB})
_FAILING = frozenset({sqlite3.SQLITE_READONLY, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM})


def translated(error: BaseException) -> ServiceError | None:
    """The error that a client is answered with; None where `error` says nothing of the storage."""
    if isinstance(error, (StorageFullError, StorageUnavailableError)):
        return error
    if isinstance(error, PoolTimeoutError):
        return StorageUnavailableError("too many requests wait for the database: try again", headers=RETRY_AFTER)
    if isinstance(error, DBAPIError):
        return _of_database(error)
    if isinstance(error, OSError) and error.errno in FULL:
        return StorageFullError(f"nothing was stored: {error.strerror}. Delete data sets or versions")
    if isinstance(error, OSError) and error.errno in UNAVAILABLE:
        return StorageUnavailableError(f"files cannot be read or written now: {error.strerror}", headers=RETRY_AFTER)
    return None


def _of_database(error: DBAPIError) -> ServiceError | None:
    code = getattr(error.orig, "sqlite_errorcode", None)
    primary = None if code is None else code & 0xFF  # the rest of an extended code says where it came up
    if primary in _BUSY:
        return StorageUnavailableError("the database is locked by another writer: try again", headers=RETRY_AFTER)
    if primary == sqlite3.SQLITE_FULL:
        return StorageFullError("nothing was stored: the disk of the database is full. Delete data sets or versions")
    if primary in _DAMAGED:
        return StorageUnavailableError(f"the database is damaged: {error.orig}; the service's log says more")
    if primary in _FAILING:
        return StorageUnavailableError(f"the database cannot be used now: {error.orig}", headers=RETRY_AFTER)
    return None


def install(app: FastAPI) -> None:
    """Answer requests that fail for the storage's sake with what they can act on."""
    for kind in (DBAPIError, PoolTimeoutError, OSError):
        app.add_exception_handler(kind, _answer)


async def _answer(request: Request, error: Exception) -> JSONResponse:
    said = translated(error)
    if said is None:
        raise error  # as unexpected as any other
    logger.error("%s at %s: %s", said.code, request.scope["path"], error)
    return answer_of(request.scope, said)
