"""Databases of release 0.2.0 are brought up to date with all that is in them, whoever comes first; older ones are
refused."""

import re
import sqlite3
from contextlib import closing

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import inspect, select

from lipcore.online.gates import ContactGate
from service.learning.streams import Streams
from service.storage.database import Base, Database, LearnerRow, ServingRow, migrations
from service.storage.database.migrations import HEAD, DatabaseVersionError
from tests.service.database.starting import check_starts_together
from tests.service.learning import batches
from tests.service.upgrades.test_homes import unpacked

FILE = "lipserve.sqlite3"


@pytest.fixture
def earlier(tmp_path):
    """A home that release 0.2.0 has made."""
    return unpacked(tmp_path / "earlier")


def execute(home, *statements):
    """Change the database of a home; return the rows of the last statement."""
    with closing(sqlite3.connect(home / FILE)) as connection, connection:
        return [connection.execute(each).fetchall() for each in statements][-1]


def test_the_last_revision_is_what_the_release_needs():
    assert ScriptDirectory(migrations.__path__[0]).get_heads() == [HEAD]


@pytest.mark.parametrize("which", ["home", "earlier"])
def test_migrations_end_in_the_tables_of_the_release(request, which):
    database = Database(request.getfixturevalue(which))
    with database.engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []
        made = set(inspect(connection).get_table_names()) - {"alembic_version"}
    assert made == set(Base.metadata.tables)
    database.close()


def test_a_model_without_a_serving_version_serves_its_newest(earlier):
    execute(earlier, "DELETE FROM serving", "DELETE FROM learners")
    database = Database(earlier)
    with database.session() as session:
        chosen = select(ServingRow.model, ServingRow.version).order_by(ServingRow.model)
        assert session.execute(chosen).all() == [("bodies", 1), ("chain", 2)]
        learning = select(LearnerRow.model, LearnerRow.version, LearnerRow.role).order_by(LearnerRow.model)
        assert session.execute(learning).all() == [("bodies", 1, "serving"), ("chain", 2, "serving")]
    database.close()


def test_snapshots_that_contain_what_was_unlearnt_later_go(earlier):
    """Event 5 of one model has unlearnt event 2; release 0.2.0 has kept a snapshot after each event."""
    snapshots = "SELECT model, number FROM snapshots ORDER BY model, number"
    assert execute(earlier, snapshots) == [*(("bodies", k) for k in range(1, 5)), *(("chain", k) for k in range(1, 6))]
    Database(earlier).close()
    assert execute(earlier, snapshots) == [*(("bodies", k) for k in range(1, 5)), ("chain", 1), ("chain", 5)]


@pytest.mark.parametrize("change", ["DROP TABLE alembic_version", "UPDATE alembic_version SET version_num = '0003'"])
def test_a_database_of_a_release_before_is_refused_as_it_is(earlier, change):
    execute(earlier, change)
    before = execute(earlier, "SELECT sql FROM sqlite_master")
    with pytest.raises(DatabaseVersionError, match=re.escape("start that release on it once (pip install")):
        Database(earlier)
    assert execute(earlier, "SELECT sql FROM sqlite_master") == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("UPDATE datasets SET report = json_remove(report, '$.timing')", r"\d+ of the datasets were made by a release"),
        ("UPDATE versions SET manifest = json_remove(manifest, '$.parameters')", r"\d+ of the versions were made by"),
    ],
)
def test_what_a_release_before_has_made_is_refused_by_name(earlier, change, message):
    execute(earlier, change)
    with pytest.raises(DatabaseVersionError, match=message):
        Database(earlier)
    assert execute(earlier, "SELECT version_num FROM alembic_version") == [("0004",)]


def test_what_reports_and_events_said_of_streams_becomes_their_records(tmp_path):
    body = {"mass": 2.0, "com": [0.0, 0.0, 0.1], "inertia": None}
    report = {
        "accepted": 4,
        "rejected": {},
        "gate": ContactGate.start(0.5).let_all_pass().to_json(),
        "opening": None,
        "doubted": True,
    }
    scale, watch = {"log": [0.0, 0.1], "owed": [0.0, 0.0], "last": 3.0}, {"state": "none", "held": None}
    database = batches.opened(tmp_path)
    batches.write(database, batches.batch(0, report=report | {"scale": scale}))  # event 1
    batches.note(database, "payload", {"stream_id": None, "body": body})  # 2
    batches.write(database, batches.batch(1, stream_id="later", report=report | {"payload": watch}))  # 3
    batches.note(database, "payload", {"stream_id": "robot-1", "body": None})  # 4
    database.close()
    added = ("streams DROP COLUMN record", "learning DROP COLUMN payload", "events DROP COLUMN clock")
    changes = (f"ALTER TABLE {each}" for each in added)
    execute(tmp_path, *changes, "UPDATE alembic_version SET version_num = '0006'")
    database = Database(tmp_path)
    with database.session() as session:
        known = Streams.restored(session, batches.MODEL)
    database.close()
    first, later = known.get("robot-1"), known.get("later")
    assert (first.gate.to_json(), first.doubted, first.received) == (report["gate"], True, 1000.0)
    assert (first.scale.version, first.scale.state.log.tolist()) == (1, scale["log"])
    assert (known.payload("robot-1").event, known.payload("robot-1").body) == (4, None)
    assert (later.payload.watch, later.payload.event, later.payload.version) == (watch, 2, 1)
    assert (known.payload("").event, known.payload("another").body) == (2, body)


def test_a_migration_that_fails_leaves_everything_as_it_was(earlier):
    execute(earlier, "ALTER TABLE events ADD COLUMN clock REAL")  # in the way of a later step
    before = execute(earlier, "SELECT sql FROM sqlite_master")
    with pytest.raises(Exception, match="clock"):
        Database(earlier)
    assert execute(earlier, "SELECT sql FROM sqlite_master") == before
    assert execute(earlier, "SELECT version_num FROM alembic_version") == [("0004",)]


def test_processes_that_start_together_migrate_once(earlier):
    check_starts_together(lambda: Database(earlier))
