"""What a failing PostgreSQL server is called: errors that it really makes, and what a client and an operator hear."""

from __future__ import annotations

import socket
import sys

import pytest
from sqlalchemy import text
from sqlalchemy.exc import SQLAlchemyError
from typer.testing import CliRunner

from service import cli
from service.foundation.errors import StorageFullError, StorageUnavailableError
from service.foundation.settings import Settings
from service.storage.database import Database
from service.storage.storage import HomeError, check_home
from service.web.storage_errors import translated

PASSWORD = "correct-horse"


@pytest.fixture
def database(shared):
    opened = Database.of(shared.settings(), 0.1)
    yield opened
    opened.close()


def failed(database, *statements):
    """The error of statements in one session, the last of which fails."""

    def run():
        with database.session() as session:
            for statement in statements:
                session.execute(text(statement))

    with pytest.raises(SQLAlchemyError) as found:
        run()
    return found.value


@pytest.mark.parametrize(
    ("state", "kind", "said"),
    [
        ("53100", StorageFullError, "full"),
        ("40P01", StorageUnavailableError, "locked"),
        ("40001", StorageUnavailableError, "locked"),
        ("08006", StorageUnavailableError, "cannot be reached"),
        ("57P03", StorageUnavailableError, "cannot be reached"),
        ("53300", StorageUnavailableError, "cannot be reached"),
        ("58030", StorageUnavailableError, "SQLSTATE 58030"),
        ("XX001", StorageUnavailableError, "SQLSTATE XX001"),
    ],
)
def test_errors_of_the_server_are_told_apart(database, state, kind, said):
    raised = failed(database, f"DO $$ BEGIN RAISE EXCEPTION 'secret detail' USING ERRCODE = '{state}'; END $$")
    told = translated(raised)
    assert type(told) is kind
    assert said in str(told)
    assert "secret" not in str(told)


def test_faults_of_ours_are_not_taken_for_the_storages(database):
    for statement in ("SELECT 1 / 0", "SELECT nothing", "INSERT INTO models (name) VALUES (NULL)"):
        assert translated(failed(database, statement)) is None


def test_a_server_that_cannot_be_written(database):
    read_only = failed(database, "SET TRANSACTION READ ONLY", "DELETE FROM jobs")
    assert isinstance(translated(read_only), StorageUnavailableError)


def test_a_connection_that_is_lost(shared, database):
    lost = failed(database, "SELECT pg_terminate_backend(pg_backend_pid())", "SELECT 1")
    assert "cannot be reached" in str(translated(lost))
    with database.session() as session:
        assert session.scalar(text("SELECT 1")) == 1
    shared.postgres.disconnect(shared.database)  # while it lies in the pool
    with database.session() as session:
        assert session.scalar(text("SELECT 1")) == 1


def test_more_requests_than_connections(shared):
    database = Database(shared.home("one"), 0.1, shared.database_url, 1)
    with database.session() as session:
        session.execute(text("SELECT 1"))
        assert "too many requests" in str(translated(failed(database, "SELECT 1")))
    database.close()


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def urls(shared):
    nowhere = f"postgresql://someone:{PASSWORD}@127.0.0.1:{free_port()}/lipserve"
    return {
        "nobody there": (nowhere, "refused"),
        "no such database": (shared.postgres.url_of("none"), "does not exist"),
        "no number": (f"postgresql://someone:{PASSWORD}@127.0.0.1:{PASSWORD}/lipserve", "cannot be read"),
    }


@pytest.mark.parametrize("which", ["nobody there", "no such database", "no number"])
def test_a_service_without_its_database_says_so_and_no_password(shared, monkeypatch, which):
    url, said = urls(shared)[which]
    with pytest.raises(HomeError, match=f"LIPSERVE_DATABASE_URL (cannot be used: .*)?{said}") as found:
        check_home(shared.settings(database_url=url))
    assert PASSWORD not in str(found.value)
    monkeypatch.setenv("LIPSERVE_DATABASE_URL", url)
    monkeypatch.setenv("LIPSERVE_FILES_URL", shared.files_url)
    monkeypatch.setenv("LIPSERVE_HOME", str(shared.home("cli")))
    for command in (["keys", "list"], ["verify"]):
        answer = CliRunner().invoke(cli.app, command)
        assert answer.exit_code == 1
        assert said in answer.output
        assert PASSWORD not in answer.output
        assert "Traceback" not in answer.output


def test_settings_that_are_refused_are_not_shown(shared):
    with pytest.raises(ValueError, match="database_url") as found:
        shared.settings(database_url=f"postgres://someone:{PASSWORD}@host/name")
    assert PASSWORD not in str(found.value)
    assert PASSWORD not in repr(Settings(database_url=f"postgresql://a:{PASSWORD}@b/c", files_url="s3://b/p"))


def test_a_driver_that_is_not_installed(shared, monkeypatch):
    monkeypatch.delitem(sys.modules, "service.storage.database.postgresql", raising=False)
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(HomeError, match=r"pip install 'lipserve\[cluster\]'"):
        check_home(shared.settings())
