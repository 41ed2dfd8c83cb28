"""What a transaction tells other services: all that was committed, and nothing that was not."""

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
from tests.cluster.servers import Postgres, Shared
from tests.service.data import eventually
from tests.service.learning.batches import MODEL, OTHER, batch


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


def notified(database: Database, *work: Callable[[], object]) -> list[tuple[str, str]]:
    """Kind and model of what a service hears while another one does things, in the order of commits."""
    heard = []
    with closing(database.changes_of_others(0.5)) as notices:
        assert next(notices) is None
        for do in work:
            do()
        while (notice := next(notices)) is not None:
            assert notice.origin == database.origin
            heard.append((notice.kind, notice.model))
    return heard


def committed(database: Database, change: Callable[..., object], *args: object) -> Callable[[], None]:
    """A change in a transaction of its own."""

    def do() -> None:
        with database.transaction() as session:
            change(session, *args)

    return do


def test_every_change_is_told_once_and_in_order(database):
    work = [
        committed(database, lambda session: [log.append_batch(session, MODEL, batch(n)) for n in (1, 2)]),
        committed(
            database, lambda session: undo.unlearn(session, MODEL, log.find_batch(session, MODEL, "robot-1", 1), 0)
        ),
        committed(database, aliases.point, OTHER, "stable", 1),
        committed(database, aliases.point, OTHER, "stable", None),
        committed(database, registry.serve, OTHER, 1),
        committed(database, lambda s: s.add(DeletedModelRow(name="gone", last_version=1, deleted_at=now()))),
    ]
    assert notified(database, *work) == [
        ("log", MODEL),
        ("log", MODEL),
        *[("model", OTHER)] * 3,
        ("model", "gone"),
    ]


def test_what_nobody_holds_in_memory_is_not_told(database):
    alarm = AlarmRow(model=MODEL, kind="novelty", at=now(), message="", evidence={})
    committed(database, log.append_batch, MODEL, batch(1))()
    retained = delete(EventRow).where(EventRow.model == MODEL)
    work = [committed(database, lambda s: s.add(alarm)), committed(database, lambda s: s.execute(retained))]
    assert notified(database, *work, lambda: database.session().__enter__().close()) == []


def test_a_service_alone_tells_and_hears_nothing(tmp_path):
    with closing(Database(tmp_path)) as alone:
        assert list(alone.changes_of_others(60.0)) == []


@pytest.mark.parametrize("payload", ["", "log", "other 12 arm"])
def test_notices_of_other_releases_are_passed_over(payload):
    found = read_notice(payload)
    assert found is None or found.model == ""
    assert read_notice(Notice("log", "arm.b-2", "0a").payload()) == ("log", "arm.b-2", "0a")


def test_a_listener_that_loses_its_connection_says_what_it_may_have_missed(database, shared, postgres: Postgres):
    heard, missed = [], threading.Semaphore(0)
    with closing(Database.of(shared.settings("two"))) as other:
        listener = Listener(other, heard.append, missed.release)
        assert missed.acquire(timeout=60)
        committed(database, log.append_batch, MODEL, batch(1))()
        eventually(lambda: len(heard) == 1)
        committed(other, log.append_batch, MODEL, batch(2))()  # its own, which it knows
        postgres.disconnect(shared.database)
        assert missed.acquire(timeout=60)
        committed(database, log.append_batch, OTHER, batch(1))()
        eventually(lambda: len(heard) == 2)
        listener.close()
    assert [(notice.kind, notice.model) for notice in heard] == [("log", MODEL), ("log", OTHER)]
