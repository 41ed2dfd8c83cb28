"""The database on a PostgreSQL server: its tables, its writers one after the other, and what it cannot hold."""

from __future__ import annotations

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import inspect, select, text
from sqlalchemy.exc import DBAPIError

from service.foundation.errors import StorageUnavailableError
from service.storage.database import Base, Database, LearningRow, ModelRow, now
from service.storage.database.migrations import DatabaseVersionError
from service.web.storage_errors import translated
from tests.service.database.starting import check_starts_together


@pytest.fixture
def database(shared):
    opened = Database.of(shared.settings(), 0.1)
    yield opened
    opened.close()


@pytest.fixture
def other(shared, database):
    """As another service sees it."""
    opened = Database.of(shared.settings("other"), 0.1)
    yield opened
    opened.close()


def add(session, *names):
    session.add_all(ModelRow(name=name, created_at=now()) for name in names)
    session.flush()


def names(database):
    with database.session() as session:
        return session.scalars(select(ModelRow.name).order_by(ModelRow.name)).all()


def test_migrations_end_in_the_tables_of_the_release(database):
    with database.engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []
        assert set(inspect(connection).get_table_names()) - {"alembic_version"} == set(Base.metadata.tables)
    assert database.shared
    assert database.adapter.damage() == database.adapter.inconsistencies(1) == []


def test_services_that_start_together_migrate_once(postgres, tmp_path):
    url = postgres.url_of(postgres.create_empty())
    check_starts_together(lambda: Database(tmp_path, url=url))


def test_a_database_of_a_later_release_is_refused(shared, database):
    with database.transaction() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(DatabaseVersionError, match=r"'9999'.*a later release"):
        Database.of(shared.settings("late"))


def test_a_transaction_is_kept_whole_or_not_at_all(database, other):
    with database.transaction() as session:
        add(session, "a")
        assert names(other) == []
    with pytest.raises(DBAPIError), database.transaction() as session:
        add(session, "b", "a")
    assert names(other) == ["a"]


@pytest.mark.parametrize(
    ("first", "second", "waits"),
    [(None, None, True), (None, "a", True), ("a", None, True), ("a", "a", True), ("a", "b", False)],
)
def test_writers_wait_for_each_other_unless_their_models_differ(database, other, first, second, waits):
    with database.transaction(first) as session:
        add(session, "one")
        if not waits:
            with other.transaction(second) as theirs:
                add(theirs, "two")
            return
        with pytest.raises(DBAPIError) as found, other.transaction(second):
            pass
    said = translated(found.value)
    assert isinstance(said, StorageUnavailableError)
    assert "locked by another writer" in str(said)
    assert said.headers == {"Retry-After": "1"}
    with other.transaction(second) as theirs:  # free again
        add(theirs, "two")
    assert names(database) == ["one", "two"]


def test_the_turn_of_a_model_is_one_services_at_a_time(database, other):
    with database.turn("a"):
        with other.turn("b"), database.transaction("a") as session:  # which is not what writers wait for
            add(session, "a")
        with pytest.raises(DBAPIError), other.turn("a"):
            pass
    with other.turn("a"):
        pass


def test_what_holds_a_lock_and_is_lost_holds_it_no_longer(shared, database, other):
    with database.engine.connect() as connection:
        database.adapter.lock(connection, None)
        pid = connection.scalar(text("SELECT pg_backend_pid()"))
        with pytest.raises(DBAPIError), other.transaction():
            pass
        shared.postgres.execute(f"SELECT pg_terminate_backend({pid})")
        with other.transaction() as session:
            add(session, "a")
        connection.invalidate()


def test_a_name_with_nul_is_not_found_and_finds_nothing(database):
    with database.transaction() as session:
        add(session, "a", "ab")
    with database.session() as session:
        for name in ("a\0b", "a\0", "\0"):
            assert session.scalars(select(ModelRow).where(ModelRow.name == name)).all() == []


def test_json_comes_back_as_it_was_but_for_numbers_that_are_none(database, other):
    kept = {"sum": 0.1 + 0.2, "small": 5e-324, "big": 10**30, "zero": -0.0, "text": "\x00\ud800\u202e", "none": None}
    with database.transaction() as session:
        add(session, "arm")
        session.add(LearningRow(model="arm", options=kept, held={"nan": float("nan"), "deep": [1.5, float("-inf")]}))
    with other.session() as session:
        row = session.get(LearningRow, "arm")
        assert repr(row.options) == repr(kept)
        assert row.held == {"nan": None, "deep": [1.5, None]}


@pytest.mark.parametrize("number", [2**31, 10**17, -1])
def test_numbers_that_a_client_may_name_are_looked_for(database, number):
    with database.session() as session:
        assert session.scalars(select(ModelRow).where(ModelRow.last_version == number)).all() == []
        assert session.get(ModelRow, number) is None


def test_rows_are_numbered_far_beyond_what_a_fleet_writes(database):
    with database.transaction() as session:
        session.execute(text(f"SELECT setval('models_seq_seq', {2**31})"))
        add(session, "a")
        session.expunge_all()
        assert session.scalars(select(ModelRow.seq)).all() == [2**31 + 1]
