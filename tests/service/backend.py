"""`--backend shared`: run the services of these tests on PostgreSQL and S3, without other changes.

A home then determines the shared storage too: settings with the same home use the same database and the same prefix,
in this process and in those that tests start.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

from service.foundation.settings import Settings

if TYPE_CHECKING:
    from tests.system.cluster.servers import S3, Postgres

OWN, SHARED = "own", "shared"
"""SQLite and files below the home of each service, or PostgreSQL and S3."""
_DATABASE, _FILES = "LIPSERVE_DATABASE_URL", "LIPSERVE_FILES_URL"
_backend: Backend | None = None


class Backend:
    """The servers, and the database and prefix of each home."""

    def __init__(self, postgres: Postgres, s3: S3) -> None:
        self._postgres, self._s3 = postgres, s3
        self._databases: dict[str, str] = {}

    def urls(self, home: Path | str) -> dict[str, str]:
        """Return the settings of a service on a home; the first call creates its database."""
        from tests.system.cluster.servers import BUCKET

        key = str(Path(home).resolve())
        if key not in self._databases:
            self._databases[key] = self._postgres.create()
        database = self._databases[key]
        return {"database_url": self._postgres.url_of(database), "files_url": f"s3://{BUCKET}/{database}"}


def environment(home: Path) -> dict[str, str]:
    """Return the environment of a service in a process of its own; empty if it uses its own files."""
    if _backend is None:
        return {}
    urls = _backend.urls(home)
    return {_DATABASE: urls["database_url"], _FILES: urls["files_url"]}


@contextmanager
def shared() -> Iterator[None]:
    """Let every service made in this block, here or by `tests.service.server`, share a database and files."""
    global _backend  # noqa: PLW0603 - tests create settings in many places
    from tests.system.cluster.servers import S3, Postgres, server_folder

    if _backend is not None:  # by another folder of tests
        yield
        return
    with server_folder() as folder:
        postgres, s3 = Postgres(folder), S3()
        _backend = Backend(postgres, s3)
        try:
            with patch.object(Settings, "__init__", _init), patch.dict(os.environ, s3.env):
                yield
        finally:
            _backend = None
            s3.close()
            postgres.close()


_own_init = Settings.__init__


def _init(self: Settings, **values: Any) -> None:
    """Replace `Settings.__init__`: add the database and the prefix of the home unless some are given."""
    home = values.get("home") or os.environ.get("LIPSERVE_HOME")
    named = {"database_url", "files_url"} & set(values) or {_DATABASE, _FILES} & set(os.environ)
    if _backend is not None and home is not None and not named:
        values |= _backend.urls(home)
    _own_init(self, **values)
