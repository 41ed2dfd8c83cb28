"""Migration of databases of release 0.2.0 without loss, also by concurrent starts; older databases are rejected."""

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
from tests.service.learning import batches
from tests.service.storage.starting import check_starts_together
from tests.system.upgrades.test_homes import unpack_home

FILE = "lipserve.sqlite3"


@pytest.fixture
def home_of_0_2_0(tmp_path):
    """A home that release 0.2.0 has made."""
    return unpack_home(tmp_path / "earlier")


def execute(home, *statements):
    """Run statements on the database of a home; return the rows of the last one."""
    with closing(sqlite3.connect(home / FILE)) as connection, connection:
        return [connection.execute(each).fetchall() for each in statements][-1]


def test_last_revision_is_that_of_the_release():
    assert ScriptDirectory(migrations.__path__[0]).get_heads() == [HEAD]


@pytest.mark.parametrize("which", ["home", "home_of_0_2_0"])
def test_migrations_end_in_the_tables_of_the_release(request, which):
    database = Database(request.getfixturevalue(which))
    with database.engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []
        made = set(inspect(connection).get_table_names()) - {"alembic_version"}
    assert made == set(Base.metadata.tables)
    database.close()


def test_model_without_a_serving_version_serves_its_newest(home_of_0_2_0):
    execute(home_of_0_2_0, "DELETE FROM serving", "DELETE FROM learners")
    database = Database(home_of_0_2_0)
    with database.session() as session:
        chosen = select(ServingRow.model, ServingRow.version).order_by(ServingRow.model)
        assert session.execute(chosen).all() == [("bodies", 1), ("chain", 2)]
        learning = select(LearnerRow.model, LearnerRow.version, LearnerRow.role).order_by(LearnerRow.model)
        assert session.execute(learning).all() == [("bodies", 1, "serving"), ("chain", 2, "serving")]
    database.close()


def test_snapshots_with_undone_batches_are_deleted(home_of_0_2_0):
    """Event 5 of one model undoes event 2; release 0.2.0 kept a snapshot after each event."""
    snapshots = "SELECT model, number FROM snapshots ORDER BY model, number"
    bodies = [("bodies", k) for k in range(1, 5)]
    assert execute(home_of_0_2_0, snapshots) == [*bodies, *(("chain", k) for k in range(1, 6))]
    Database(home_of_0_2_0).close()
    assert execute(home_of_0_2_0, snapshots) == [*bodies, ("chain", 1), ("chain", 5)]


def dump(home):
    with closing(sqlite3.connect(home / FILE)) as connection:
        return list(connection.iterdump())


OLDER = re.escape("start that release on it once (pip install")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("DROP TABLE alembic_version", OLDER),
        ("UPDATE alembic_version SET version_num = '0003'", OLDER),
        ("UPDATE datasets SET report = json_remove(report, '$.timing')", r"\d+ of the datasets were made by a release"),
        ("UPDATE versions SET manifest = json_remove(manifest, '$.parameters')", r"\d+ of the versions were made by"),
    ],
)
def test_database_of_an_older_release_is_rejected_unchanged(home_of_0_2_0, change, message):
    execute(home_of_0_2_0, change)
    before = dump(home_of_0_2_0)
    with pytest.raises(DatabaseVersionError, match=message):
        Database(home_of_0_2_0)
    assert dump(home_of_0_2_0) == before


@pytest.mark.own_files("it reads the home's SQLite file")
def test_stream_reports_and_events_become_records(tmp_path):
    body = {"mass": 2.0, "com": [0.0, 0.0, 0.1], "inertia": None}
    gate = ContactGate.start(0.5).let_all_pass().to_json()
    report = {"accepted": 4, "rejected": {}, "gate": gate, "opening": None, "doubted": True}
    scale, watch = {"log": [0.0, 0.1], "owed": [0.0, 0.0], "last": 3.0}, {"state": "none", "held": None}
    database = batches.open_database(tmp_path)
    batches.append_batches(database, batches.make_batch(0, report=report | {"scale": scale}))  # event 1
    batches.append_event(database, "payload", {"stream_id": None, "body": body})  # 2
    batches.append_batches(database, batches.make_batch(1, stream_id="later", report=report | {"payload": watch}))  # 3
    batches.append_event(database, "payload", {"stream_id": "robot-1", "body": None})  # 4
    database.close()
    added = ("streams DROP COLUMN record", "learning DROP COLUMN payload", "events DROP COLUMN clock")
    added += ("models DROP COLUMN thresholds", "versions DROP COLUMN note", "versions DROP COLUMN tags")
    changes = (f"ALTER TABLE {each}" for each in added)
    dropped = ("DROP TABLE alarm_events", "DROP TABLE deleted_jobs")
    execute(tmp_path, *changes, *dropped, "UPDATE alembic_version SET version_num = '0006'")
    database = Database(tmp_path)
    with database.session() as session:
        known = Streams.restored(session, batches.MODEL)
    database.close()
    first, later = known.get("robot-1"), known.get("later")
    assert (first.gate.to_json(), first.doubted, first.received) == (gate, True, 1000.0)
    assert (first.scale.version, first.scale.state.log.tolist()) == (1, scale["log"])
    assert (known.payload("robot-1").event, known.payload("robot-1").body) == (4, None)
    assert (later.payload.watch, later.payload.event, later.payload.version) == (watch, 2, 1)
    assert (known.payload("").event, known.payload("another").body) == (2, body)


def test_failed_migration_changes_nothing(home_of_0_2_0):
    execute(home_of_0_2_0, "ALTER TABLE events ADD COLUMN clock REAL")  # conflicts with a later step
    before = dump(home_of_0_2_0)
    with pytest.raises(Exception, match="clock"):
        Database(home_of_0_2_0)
    assert dump(home_of_0_2_0) == before


def test_processes_that_start_together_migrate_once(home_of_0_2_0):
    check_starts_together(lambda: Database(home_of_0_2_0))
