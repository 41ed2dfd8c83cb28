"""Errors of the database and the operating system, translated into errors of the service.

After such an error nothing was stored: files are written whole or not at all, rows in transactions. The exception is an
interrupted commit, after a lost connection or a failed sync of the disk (`is_undecided`). A repeated batch is
recognised by its sequence number, other requests by their idempotency key.
"""

from __future__ import annotations

import errno
import sqlite3

from sqlalchemy.exc import DBAPIError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from service.foundation.errors import ServiceError, StorageFullError, StorageUnavailableError

FULL_ERRNOS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Errors of the operating system: the disk, a quota or the max file size is used up."""
UNAVAILABLE_ERRNOS = frozenset(
    getattr(errno, name)
    for name in ("EROFS", "EIO", "EACCES", "EPERM", "EMFILE", "ENFILE", "ENODEV", "ENXIO", "ESTALE", "ENOTCONN")
    if hasattr(errno, name)
)
RETRY_AFTER = {"Retry-After": "1"}
_LOCKED = "the database is locked by another writer: try again"
_LOST = "the database server cannot be reached now: try again"
_NO_SPACE = "nothing was stored: the disk of the database is full. Delete data sets or versions"


def translate_error(error: BaseException) -> ServiceError | None:
    """Return the error for the client; None if `error` is not about storage."""
    if isinstance(error, (StorageFullError, StorageUnavailableError)):
        return error
    if isinstance(error, PoolTimeoutError):
        return StorageUnavailableError("too many requests wait for the database: try again", headers=RETRY_AFTER)
    if isinstance(error, DBAPIError):
        return _of_database(error)
    if isinstance(error, OSError) and error.errno in FULL_ERRNOS:
        return StorageFullError(f"nothing was stored: {error.strerror}. Delete data sets or versions")
    if isinstance(error, OSError) and error.errno in UNAVAILABLE_ERRNOS:
        return StorageUnavailableError(f"files cannot be read or written now: {error.strerror}", headers=RETRY_AFTER)
    return None


def is_undecided(error: BaseException) -> bool:
    """Return whether a failed transaction may have been stored, so that its files must be kept.

    A commit that could not be synced is complete in SQLite's log. The next start finds it there, unless another commit
    replaced it.
    """
    if not isinstance(error, DBAPIError):
        return False
    return error.connection_invalidated or _code(error) == sqlite3.SQLITE_IOERR


def _of_database(error: DBAPIError) -> ServiceError | None:
    if error.orig is not None and hasattr(error.orig, "sqlstate"):
        return _of_postgresql(error, error.orig.sqlstate)
    primary = _code(error)
    if primary in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
        return StorageUnavailableError(_LOCKED, headers=RETRY_AFTER)
    if primary == sqlite3.SQLITE_FULL:
        return StorageFullError(_NO_SPACE)
    if primary is None and "decode to UTF-8" in str(error.orig):  # by the driver, which adds the whole text
        return StorageUnavailableError("the database is damaged: a text is not UTF-8; run `lipserve verify`")
    if primary in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
        return StorageUnavailableError(f"the database is damaged: {error.orig}; see the service's log")
    if primary in (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM):
        return StorageUnavailableError(f"the database cannot be used now: {error.orig}", headers=RETRY_AFTER)
    return None


def _code(error: DBAPIError) -> int | None:
    """Return SQLite's primary code, without the place of the error that an extended code adds."""
    code: int | None = getattr(error.orig, "sqlite_errorcode", None)
    return None if code is None else code & 0xFF


def _of_postgresql(error: DBAPIError, state: str | None) -> ServiceError | None:
    """Return the error for an SQLSTATE, None without connection. PostgreSQL's own text contains hosts and users."""
    if state is None:
        lost = error.connection_invalidated or isinstance(error, OperationalError)
        return StorageUnavailableError(_LOST, headers=RETRY_AFTER) if lost else None
    # lock not available, query cancelled, serialization failure, deadlock
    if state in ("55P03", "57014", "40001", "40P01"):
        return StorageUnavailableError(_LOCKED, headers=RETRY_AFTER)
    if state == "53100":
        return StorageFullError(_NO_SPACE)
    # connection broken or refused, server stops or starts, idle for too long, too many
    if state.startswith(("08", "57P", "25P03", "53300")):
        return StorageUnavailableError(_LOST, headers=RETRY_AFTER)
    # read-only, no access, no such database, out of memory and the like, its disk, its own faults
    if state.startswith(("25006", "28", "3D", "42501", "53", "58", "XX")):
        message = f"the database cannot be used now: SQLSTATE {state}; see the service's log"
        return StorageUnavailableError(message, headers=RETRY_AFTER)
    return None
