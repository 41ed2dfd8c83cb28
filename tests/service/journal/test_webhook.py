"""Alarms to a webhook: a real receiver that is down, slow, wrong or elsewhere, and a service that is killed."""

import json
import logging
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from sqlalchemy import select

from lipserve import SignatureError, read_alarm_event
from service.foundation.settings import Settings
from service.journal import alarms, webhook
from service.journal.webhook import MAX_RETRY_S, RETRY_S, Webhook
from service.storage.database import AlarmEventRow, Database
from tests.service.data import eventually
from tests.service.learning import batches
from tests.service.server import Server, free_port

SECRET = "a secret of many letters"
DAY_S = 86400.0


class Receiver(ThreadingHTTPServer):
    """A receiver; `answers` are the statuses of its next answers, then 204. None: it does not answer."""

    daemon_threads = True

    def __init__(self, port: int = 0) -> None:
        super().__init__(("127.0.0.1", port), Handler)
        self.answers: list[int | None] = []
        self.requests: list[tuple[str, bytes, str]] = []
        self.ended = threading.Event()
        self.url = f"http://127.0.0.1:{self.server_address[1]}/hook"
        threading.Thread(target=self.serve_forever, args=(0.01,), daemon=True).start()

    def events(self):
        """Return the received events; raise SignatureError."""
        return [read_alarm_event(body, signature, SECRET) for _, body, signature in self.requests]

    def end(self):
        self.ended.set()
        self.shutdown()
        self.server_close()


class Handler(BaseHTTPRequestHandler):
    server: Receiver

    def do_POST(self):
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.requests.append((self.path, body, self.headers["LIPServe-Signature"]))
        status = self.server.answers.pop(0) if self.server.answers else 204
        if status is None:
            self.server.ended.wait()
            return
        self.send_response(status)
        self.send_header("Location", "/elsewhere")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_):
        pass


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    started = Receiver()
    yield started
    started.end()


@pytest.fixture
def database(home) -> Iterator[Database]:
    opened = batches.open_database(home)
    yield opened
    opened.close()


class Time:
    """A clock that begins at the true time, so that new events are due."""

    def __init__(self, database):
        with database.session() as session:
            self.now = session.scalar(select(AlarmEventRow.due)) or 0.0

    def __call__(self):
        return self.now


def raise_alarm(database, message="changed", clears=False):
    with database.transaction() as session:
        alarms.raise_alarm(session, batches.MODEL, "friction", message, {"joints": ["joint1"]}, clears)


def sender(home, database, url):
    clock = Time(database)
    return Webhook(database, Settings(home=home, alarm_webhook=url, alarm_webhook_secret=SECRET), clock), clock


def counts(hook):
    """Return the metrics: attempts by outcome, and the number of waiting events."""
    sent, waiting = (family.samples for family in hook.collect())
    return *(int(each.value) for each in sent), int(waiting[0].value)


def test_event_is_signed_and_sent_once(home, database, receiver):
    raise_alarm(database, "Coulomb −0.25 ± 0.1 N·m")
    raise_alarm(database, "plausible", clears=True)
    hook, clock = sender(home, database, receiver.url)
    clock.now += 1.0
    assert [hook.send_next() for _ in range(3)] == [True, True, False]
    raised, cleared = receiver.events()
    assert (raised.type, raised.model, raised.kind) == ("alarm.raised", batches.MODEL, "friction")
    assert (raised.message, raised.evidence) == ("Coulomb −0.25 ± 0.1 N·m", {"joints": ["joint1"]})
    assert cleared.type == "alarm.cleared"
    assert raised.id != cleared.id
    assert counts(hook) == (2, 0, 0, 0)


def test_wrong_signatures_are_rejected(home, database, receiver):
    raise_alarm(database)
    hook, clock = sender(home, database, receiver.url)
    assert hook.send_next()
    ((_, body, signature),) = receiver.requests
    for given, text, secret, at in (
        (body + b" ", signature, SECRET, clock.now),
        (body, signature, "another secret of mine", clock.now),
        (body, signature, SECRET, clock.now + 400.0),
        (body, signature.replace("t=", "t=1"), SECRET, clock.now),
        (body, "", SECRET, clock.now),
    ):
        with pytest.raises(SignatureError):
            read_alarm_event(given, text, secret, now=at)
    assert read_alarm_event(body, signature, SECRET, now=clock.now + 200.0).id == json.loads(body)["id"]


@pytest.mark.parametrize("fault", ["down", "slow", 500, 302, 404])
def test_failed_event_is_sent_again_later_and_later(home, database, receiver, fault, monkeypatch, caplog):
    monkeypatch.setattr(webhook, "ANSWER_S", 0.1)
    receiver.answers = [] if fault == "down" else 3 * [None if fault == "slow" else fault]
    raise_alarm(database)
    url = f"http://127.0.0.1:{free_port()}/hook" if fault == "down" else receiver.url
    hook, clock = sender(home, database, url)
    with caplog.at_level(logging.INFO, "service.journal.webhook"):
        for pause in (0.0, RETRY_S, 2.0 * RETRY_S):
            clock.now += pause
            assert not hook.send_next()  # an attempt that fails
            assert not hook.send_next()  # none is due
        assert counts(hook) == (0, 3, 0, 1)
        hook._url = receiver.url
        clock.now += 4.0 * RETRY_S
        assert hook.send_next()
    assert counts(hook) == (1, 3, 0, 0)
    assert [path for path, _, _ in receiver.requests] == ["/hook"] * (1 if fault == "down" else 4)  # not redirected
    assert len({json.loads(body)["id"] for _, body, _ in receiver.requests}) == 1
    levels = [record.levelname for record in caplog.records if record.name == "service.journal.webhook"]
    assert levels == ["WARNING", "INFO"]


def test_waits_are_bounded_and_old_events_are_dropped(home, database):
    raise_alarm(database)
    hook, clock = sender(home, database, f"http://127.0.0.1:{free_port()}")
    attempts, start = 0, clock.now
    while clock.now <= start + DAY_S:
        hook.send_next()
        attempts += 1
        clock.now = due(database)
    assert attempts > (DAY_S - 4 * MAX_RETRY_S) / MAX_RETRY_S
    assert not hook.send_next()
    assert counts(hook) == (0, attempts, 1, 0)


def due(database):
    with database.session() as session:
        return session.scalar(select(AlarmEventRow.due))


def test_without_webhook_events_do_not_pile_up(home, database):
    raise_alarm(database)
    with database.transaction() as session:
        session.scalar(select(AlarmEventRow)).at -= 3 * DAY_S
    raise_alarm(database)
    with database.session() as session:
        assert len(session.scalars(select(AlarmEventRow)).all()) == 1
    assert counts(Webhook(database, Settings(home=home))) == (0, 0, 0, 0)


@pytest.mark.parametrize("secret", [None, "short"])
def test_webhook_needs_a_long_secret_which_is_never_shown(secret):
    with pytest.raises(ValueError, match="alarm_webhook"):
        Settings(alarm_webhook="https://example.org/hook", alarm_webhook_secret=secret)
    assert SECRET not in repr(Settings(alarm_webhook="https://example.org/hook", alarm_webhook_secret=SECRET))


@pytest.mark.slow
def test_event_survives_a_killed_service(home):
    database = batches.open_database(home)
    raise_alarm(database)
    port = free_port()
    settings = {"LIPSERVE_ALARM_WEBHOOK": f"http://127.0.0.1:{port}/hook", "LIPSERVE_ALARM_WEBHOOK_SECRET": SECRET}
    start = due(database)
    with Server(home, **settings) as server:
        eventually(lambda: due(database) > start)  # an attempt has been claimed
        server.kill()
    with database.transaction() as session:  # the wait is over
        session.scalar(select(AlarmEventRow)).due = start
    receiver = Receiver(port)
    try:
        with Server(home, **settings) as server:
            eventually(lambda: due(database) is None)
            text = server.client.get("/metrics").text
        assert [each.message for each in receiver.events()] == ["changed"]
        assert "/hook" not in server.log.read_text()  # the path of a webhook is often a secret
        assert 'lipserve_webhook_total{outcome="delivered"} 1.0' in text
    finally:
        receiver.end()
        database.close()
