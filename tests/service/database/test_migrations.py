"""Databases of earlier releases: brought up to date with all that is in them, whoever comes first."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import inspect, select

from service.learning.ingest.judging import ContactGate
from service.learning.streams import Streams
from service.storage.database import (
    Base,
    Database,
    JobRow,
    LearnerRow,
    ModelRow,
    ServingRow,
    SnapshotRow,
    VersionRow,
    migrations,
)
from service.storage.database.migrations import HEAD
from tests.service.database.starting import check_starts_together
from tests.service.learning import batches

BEFORE = (Path(__file__).parent / "before_migrations.sql").read_text()
FILE = "lipserve.sqlite3"


@pytest.fixture
def earlier(home):
    """A home whose database an earlier release has made."""
    home.mkdir()
    connection = sqlite3.connect(home / FILE)
    connection.executescript(BEFORE)
    connection.close()
    return home


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


def test_what_an_earlier_release_stored_is_kept(earlier):
    database = Database(earlier)
    with database.session() as session:
        assert session.scalars(select(VersionRow.version)).all() == [1, 2, 3]
        assert session.scalars(select(ModelRow.last_version)).all() == [3]
        [job] = session.scalars(select(JobRow))
        assert (job.id, job.state, job.history, job.retry_of) == ("job_1", "queued", [], None)
        assert session.scalars(select(SnapshotRow.sha256)).all() == [None]
        [serving], [learner] = session.scalars(select(ServingRow)), session.scalars(select(LearnerRow))
        assert (serving.model, serving.version) == (learner.model, learner.version) == ("arm", 3)
        assert learner.role == "serving"
    database.close()


def test_what_reports_and_events_said_of_streams_becomes_their_records(tmp_path):
    body = {"mass": 2.0, "com": [0.0, 0.0, 0.1], "inertia": None}
    report = {
        "accepted": 4,
        "rejected": {},
        "gate": ContactGate.start(0.5).stand_back().to_json(),
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
    with closing(sqlite3.connect(tmp_path / FILE)) as connection:
        for change in ("streams DROP COLUMN record", "learning DROP COLUMN payload", "events DROP COLUMN clock"):
            connection.execute(f"ALTER TABLE {change}")
        connection.execute("UPDATE alembic_version SET version_num = '0006'")
        connection.commit()
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
    connection = sqlite3.connect(earlier / FILE)
    connection.execute("CREATE TABLE api_keys (something TEXT)")  # in the way of a later step
    connection.close()
    with pytest.raises(Exception, match="api_keys"):
        Database(earlier)
    connection = sqlite3.connect(earlier / FILE)
    tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    assert "alembic_version" not in tables
    assert "aliases" not in tables
    assert connection.execute("SELECT COUNT(*) FROM versions").fetchone() == (3,)
    connection.close()


def test_processes_that_start_together_migrate_once(earlier):
    check_starts_together(lambda: Database(earlier))
