"""The database on a PostgreSQL server: tables, serialised writers, and translation of errors."""

import os
import socket
import sys
from contextlib import closing

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import delete, inspect, select, text
from sqlalchemy.exc import DBAPIError, SQLAlchemyError
from typer.testing import CliRunner

from service import cli
from service.foundation.errors import StorageFullError, StorageUnavailableError
from service.foundation.settings import Settings
from service.storage.database import Base, Database, LearningRow, ModelRow, now
from service.storage.errors import translate_error
from service.storage.storage import HomeError, check_home
from tests.service.server import free_port
from tests.service.storage.starting import check_starts_together
from tests.system.histories.proxy import Proxy


@pytest.fixture
def database(shared):
    opened = Database.of(shared.settings(), 0.1)
    yield opened
    opened.close()


@pytest.fixture
def other(shared, database):
    """The same database, opened by another service."""
    opened = Database.of(shared.settings("other"), 0.1)
    yield opened
    opened.close()


def add(session, *names):
    session.add_all(ModelRow(name=name, created_at=now()) for name in names)
    session.flush()


def names(database):
    with database.session() as session:
        return session.scalars(select(ModelRow.name).order_by(ModelRow.name)).all()


def test_migrations_create_tables_of_release(database):
    with database.engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []
        assert set(inspect(connection).get_table_names()) - {"alembic_version"} == set(Base.metadata.tables)
    assert database.shared
    assert database.adapter.damage() == database.adapter.inconsistencies(1) == []


def test_services_starting_together_migrate_once(postgres, tmp_path):
    url = postgres.url_of(postgres.create_empty())
    check_starts_together(lambda: Database(tmp_path, url=url))


def test_snapshot_session_ignores_later_commits(database, other):
    with database.transaction() as session:
        add(session, "one")
    with database.moment() as session:
        assert session.scalars(select(ModelRow.name)).all() == ["one"]
        with other.transaction() as other_session:
            other_session.execute(delete(ModelRow))
            add(other_session, "two")
        assert session.scalars(select(ModelRow.name)).all() == ["one"]
    assert names(database) == ["two"]


def test_silent_network_times_out(shared):
    """The server falls silent: by default a request would hang for 15 minutes to two hours."""
    proxy = Proxy(shared.database_url)
    settings = shared.settings(database_url=proxy.url)
    try:
        with closing(Database.of(settings, 1.0)) as opened, opened.engine.connect() as connection:
            connection.execute(text("SELECT 1"))
            line = socket.socket(fileno=os.dup(connection.connection.fileno()))
            with line:
                for name, maximum in (("TCP_USER_TIMEOUT", 30_000), ("TCP_KEEPIDLE", 15), ("TCP_KEEPINTVL", 10)):
                    assert 0 < line.getsockopt(socket.IPPROTO_TCP, getattr(socket, name)) <= maximum
    finally:
        proxy.close()


@pytest.mark.parametrize(
    ("first", "second", "waits"),
    [(None, None, True), (None, "a", True), ("a", None, True), ("a", "a", True), ("a", "b", False)],
)
def test_writers_wait_unless_their_models_differ(database, other, first, second, waits):
    with database.transaction(first) as session:
        add(session, "one")
        if not waits:
            with other.transaction(second) as other_session:
                add(other_session, "two")
            return
        with pytest.raises(DBAPIError) as found, other.transaction(second):
            pass
    error = translate_error(found.value)
    assert isinstance(error, StorageUnavailableError)
    assert "locked by another writer" in str(error)
    assert error.headers == {"Retry-After": "1"}
    with other.transaction(second) as other_session:  # free again
        add(other_session, "two")
    assert names(database) == ["one", "two"]


def test_turn_of_model_belongs_to_one_service(database, other):
    with database.turn("a"):
        with other.turn("b"), database.transaction("a") as session:  # a turn is independent of the writers' lock
            add(session, "a")
        with pytest.raises(DBAPIError), other.turn("a"):
            pass
    with other.turn("a"):
        pass


def test_lost_connection_releases_its_lock(shared, database, other):
    with database.engine.connect() as connection:
        database.adapter.lock(connection, None)
        pid = connection.scalar(text("SELECT pg_backend_pid()"))
        with pytest.raises(DBAPIError), other.transaction():
            pass
        shared.postgres.execute(f"SELECT pg_terminate_backend({pid})")
        with other.transaction() as session:
            add(session, "a")
        connection.invalidate()


def test_name_with_nul_matches_nothing(database):
    with database.transaction() as session:
        add(session, "a", "ab")
    with database.session() as session:
        for name in ("a\0b", "a\0", "\0"):
            assert session.scalars(select(ModelRow).where(ModelRow.name == name)).all() == []


def test_json_is_stored_exactly_except_non_finite_numbers(database, other):
    kept = {"sum": 0.1 + 0.2, "small": 5e-324, "big": 10**30, "zero": -0.0, "text": "\x00\ud800\u202e", "none": None}
    with database.transaction() as session:
        add(session, "arm")
        session.add(LearningRow(model="arm", options=kept, held={"nan": float("nan"), "deep": [1.5, float("-inf")]}))
    with other.session() as session:
        row = session.get(LearningRow, "arm")
        assert repr(row.options) == repr(kept)
        assert row.held == {"nan": None, "deep": [1.5, None]}


@pytest.mark.parametrize("number", [2**31, 10**17, -1])
def test_out_of_range_numbers_match_nothing(database, number):
    with database.session() as session:
        assert session.scalars(select(ModelRow).where(ModelRow.last_version == number)).all() == []
        assert session.get(ModelRow, number) is None


PASSWORD = "correct-horse"


def run_failing(database, *statements):
    """Run statements in one session, the last of which fails; return its error."""

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
def test_server_errors_are_translated_by_sqlstate(database, state, kind, said):
    raised = run_failing(database, f"DO $$ BEGIN RAISE EXCEPTION 'secret detail' USING ERRCODE = '{state}'; END $$")
    translated = translate_error(raised)
    assert type(translated) is kind
    assert said in str(translated)
    assert "secret" not in str(translated)


def test_programming_errors_are_not_storage_errors(database):
    for statement in ("SELECT 1 / 0", "SELECT nothing", "INSERT INTO models (name) VALUES (NULL)"):
        assert translate_error(run_failing(database, statement)) is None


def test_lost_connection_is_replaced(shared, database):
    lost = run_failing(database, "SELECT pg_terminate_backend(pg_backend_pid())", "SELECT 1")
    assert "cannot be reached" in str(translate_error(lost))
    with database.session() as session:
        assert session.scalar(text("SELECT 1")) == 1
    shared.postgres.disconnect(shared.database)  # while it is idle in the pool
    with database.session() as session:
        assert session.scalar(text("SELECT 1")) == 1


def test_requests_beyond_connection_limit_fail(shared):
    database = Database(shared.home("one"), 0.1, shared.database_url, 1)
    with database.session() as session:
        session.execute(text("SELECT 1"))
        assert "too many requests" in str(translate_error(run_failing(database, "SELECT 1")))
    database.close()


def bad_urls(shared):
    nowhere = f"postgresql://someone:{PASSWORD}@127.0.0.1:{free_port()}/lipserve"
    return {
        "connection refused": (nowhere, "refused"),
        "no such database": (shared.postgres.url_of("none"), "does not exist"),
        "invalid port": (f"postgresql://someone:{PASSWORD}@127.0.0.1:{PASSWORD}/lipserve", "cannot be read"),
    }


@pytest.mark.parametrize("which", ["connection refused", "no such database", "invalid port"])
def test_unusable_database_is_reported_without_password(shared, monkeypatch, which):
    url, expected = bad_urls(shared)[which]
    with pytest.raises(HomeError, match=f"LIPSERVE_DATABASE_URL (cannot be used: .*)?{expected}") as found:
        check_home(shared.settings(database_url=url))
    assert PASSWORD not in str(found.value)
    monkeypatch.setenv("LIPSERVE_DATABASE_URL", url)
    monkeypatch.setenv("LIPSERVE_FILES_URL", shared.files_url)
    monkeypatch.setenv("LIPSERVE_HOME", str(shared.home("cli")))
    for command in (["keys", "list"], ["verify"]):
        answer = CliRunner().invoke(cli.app, command)
        assert answer.exit_code == 1
        assert expected in answer.output
        assert PASSWORD not in answer.output
        assert "Traceback" not in answer.output


def test_rejected_settings_hide_the_password(shared):
    with pytest.raises(ValueError, match="database_url") as found:
        shared.settings(database_url=f"postgres://someone:{PASSWORD}@host/name")
    assert PASSWORD not in str(found.value)
    assert PASSWORD not in repr(Settings(database_url=f"postgresql://a:{PASSWORD}@b/c", files_url="s3://b/p"))


def test_missing_driver_is_reported(shared, monkeypatch):
    monkeypatch.delitem(sys.modules, "service.storage.database.postgresql", raising=False)
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(HomeError, match=r"pip install 'lipserve\[cluster\]'"):
        check_home(shared.settings())
