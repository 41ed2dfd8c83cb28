"""Notices of transactions to other services: everything committed, and nothing else."""

import threading
from collections.abc import Callable, Iterator
from contextlib import closing

import pytest
from sqlalchemy import delete

from service.journal import log, undo
from service.models import aliases, registry
from service.replication import Listener
from service.storage.database import AlarmRow, Database, DeletedModelRow, EventRow, ModelRow, VersionRow, now
from service.storage.database.engine import Notice, read_notice
from tests.service.data import eventually
from tests.service.learning.batches import MODEL, OTHER, make_batch
from tests.system.cluster.servers import Postgres, Shared


@pytest.fixture
def database(shared: Shared) -> Iterator[Database]:
    """A database with two models, each of one version."""
    with closing(Database.of(shared.settings("one"))) as opened:
        with opened.transaction() as session:
            session.add_all(ModelRow(name=name, created_at=now()) for name in (MODEL, OTHER))
            session.flush()
            for name in (MODEL, OTHER):
                row = VersionRow(model=name, version=1, folder=f"mv_{name}", created_at=now(), job=None, manifest={})
                session.add(row)
        yield opened


def collect_notices(database: Database, *work: Callable[[], object]) -> list[tuple[str, str]]:
    """Return kind and model of the notices that a service receives while another one runs functions, in commit
    order."""
    received = []
    with closing(database.changes_of_others(0.5)) as notices:
        assert next(notices) is None
        for do in work:
            do()
        while (notice := next(notices)) is not None:
            assert notice.origin == database.origin
            received.append((notice.kind, notice.model))
    return received


def in_transaction(database: Database, change: Callable[..., object], *args: object) -> Callable[[], None]:
    """Return a function that makes a change in its own transaction."""

    def do() -> None:
        with database.transaction() as session:
            change(session, *args)

    return do


def test_changes_are_notified_once_and_in_order(database):
    work = [
        in_transaction(database, lambda session: [log.append_batch(session, MODEL, make_batch(n)) for n in (1, 2)]),
        in_transaction(
            database, lambda session: undo.unlearn(session, MODEL, log.find_batch(session, MODEL, "robot-1", 1), 0)
        ),
        in_transaction(database, aliases.point, OTHER, "stable", 1),
        in_transaction(database, aliases.point, OTHER, "stable", None),
        in_transaction(database, registry.serve, OTHER, 1),
        in_transaction(database, lambda s: s.add(DeletedModelRow(name="gone", last_version=1, deleted_at=now()))),
    ]
    assert collect_notices(database, *work) == [
        ("log", MODEL),
        ("log", MODEL),
        *[("model", OTHER)] * 3,
        ("model", "gone"),
    ]


def test_changes_of_uncached_rows_are_not_notified(database):
    alarm = AlarmRow(model=MODEL, kind="novelty", at=now(), message="", evidence={})
    in_transaction(database, log.append_batch, MODEL, make_batch(1))()
    retained = delete(EventRow).where(EventRow.model == MODEL)
    work = [in_transaction(database, lambda s: s.add(alarm)), in_transaction(database, lambda s: s.execute(retained))]
    assert collect_notices(database, *work, lambda: database.session().__enter__().close()) == []


def test_single_service_sends_no_notices(tmp_path):
    with closing(Database(tmp_path)) as alone:
        assert list(alone.changes_of_others(60.0)) == []


@pytest.mark.parametrize("payload", ["", "log", "other 12 arm"])
def test_notices_of_other_releases_are_ignored(payload):
    found = read_notice(payload)
    assert found is None or found.model == ""
    assert read_notice(Notice("log", "arm.b-2", "0a").payload()) == ("log", "arm.b-2", "0a")


def test_listener_reports_lost_connection(database, shared, postgres: Postgres):
    received, missed = [], threading.Semaphore(0)
    with closing(Database.of(shared.settings("two"))) as other:
        listener = Listener(other, received.append, missed.release)
        assert missed.acquire(timeout=60)
        in_transaction(database, log.append_batch, MODEL, make_batch(1))()
        eventually(lambda: len(received) == 1)
        in_transaction(other, log.append_batch, MODEL, make_batch(2))()  # its own notice, which it ignores
        postgres.disconnect(shared.database)
        assert missed.acquire(timeout=60)
        in_transaction(database, log.append_batch, OTHER, make_batch(1))()
        eventually(lambda: len(received) == 2)
        listener.close()
    assert [(notice.kind, notice.model) for notice in received] == [("log", MODEL), ("log", OTHER)]
