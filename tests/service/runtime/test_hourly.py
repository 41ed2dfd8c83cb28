"""Hourly chores: what is too old is deleted, nothing else, and the counters of jobs stay."""

import asyncio
import threading
from datetime import UTC, datetime, timedelta

import pytest
from prometheus_client.exposition import generate_latest
from prometheus_client.registry import CollectorRegistry
from sqlalchemy import select

from lipserve.states import CANCELLED, FAILED, RUNNING, SUCCEEDED
from service.foundation.settings import Settings
from service.journal import alarms
from service.models import aliases
from service.runtime import hourly
from service.storage.database import AlarmRow, AliasMoveRow, Database, JobRow, ModelRow, VersionRow
from service.training import ended
from service.training.metrics import JobMetrics

MODEL = "arm"
SETTINGS = Settings(audit_retention_s=10 * 86400.0)


@pytest.fixture
def database(home):
    opened = Database.of(Settings(home=home))
    with opened.transaction() as session:
        session.add(ModelRow(name=MODEL, created_at=days_ago(400)))
    yield opened
    opened.close()


def days_ago(days):
    return (datetime.now(UTC) - timedelta(days=days)).isoformat(timespec="milliseconds")


def add_job(session, name, state, days, minutes):
    finished = datetime.fromisoformat(days_ago(days))
    dates = {"started_at": (finished - timedelta(minutes=minutes)).isoformat(), "created_at": days_ago(days + 1)}
    row = JobRow(id=name, model=MODEL, state=state, request={}, progress={}, **dates)
    row.finished_at = None if state == RUNNING else finished.isoformat()
    session.add(row)


def read_metrics(database):
    registry = CollectorRegistry()
    registry.register(JobMetrics(database))
    return generate_latest(registry).decode()


def test_old_jobs_are_deleted_and_still_counted(database):
    with database.transaction() as session:
        for name, state, days, minutes in (
            ("old", SUCCEEDED, 11, 2),
            ("failed", FAILED, 12, 200),
            ("again", FAILED, 12, 20),
            ("cancelled", CANCELLED, 300, 0.1),
            ("kept", SUCCEEDED, 12, 2),
            ("young", SUCCEEDED, 9, 20),
            ("running", RUNNING, 12, 5),
        ):
            add_job(session, name, state, days, minutes)
        version = {"folder": "mv", "created_at": days_ago(12), "job": "kept", "manifest": {}, "checksums": None}
        session.add(VersionRow(model=MODEL, version=1, **version))
    before = read_metrics(database)
    assert 'lipserve_jobs_finished_total{outcome="succeeded"} 3.0' in before
    assert (ended.clean(database, SETTINGS), ended.clean(database, SETTINGS)) == (4, 0)
    with database.session() as session:
        assert set(session.scalars(select(JobRow.id))) == {"kept", "young", "running"}
    assert read_metrics(database) == before


def test_old_alarms_are_deleted(database):
    with database.transaction() as session:
        for days in (9, 11):
            session.add(AlarmRow(model=MODEL, kind="clock", at=days_ago(days), message=str(days), evidence={}))
    assert (alarms.clean(database, SETTINGS), alarms.clean(database, SETTINGS)) == (1, 0)
    with database.session() as session:
        assert [row.message for row in session.scalars(select(AlarmRow))] == ["9"]


def test_last_moves_of_an_alias_are_kept_whatever_their_age(database):
    with database.transaction() as session:
        for alias, count, days in (("busy", 25, 11), ("quiet", 3, 300), ("young", 30, 1)):
            for version in range(count):
                session.add(AliasMoveRow(model=MODEL, alias=alias, version=version, before=None, at=days_ago(days)))
                session.flush()
    assert (aliases.clean(database, SETTINGS), aliases.clean(database, SETTINGS)) == (5, 0)
    with database.session() as session:
        left = [(row.alias, row.version) for row in session.scalars(select(AliasMoveRow).order_by(AliasMoveRow.seq))]
    expected = {"busy": range(5, 25), "quiet": range(3), "young": range(30)}
    assert left == [(alias, version) for alias, versions in expected.items() for version in versions]


def test_failing_chore_does_not_stop_the_others(monkeypatch, caplog):
    monkeypatch.setattr(hourly, "EVERY_S", 0.0)
    done = threading.Event()

    def fail():
        raise OSError("the disk is gone")

    async def run():
        async with hourly.run_hourly({"lines": fail, "jobs": done.set}):
            while not done.is_set():
                await asyncio.sleep(0)

    asyncio.run(run())
    assert "could not delete old lines: the disk is gone" in caplog.text
