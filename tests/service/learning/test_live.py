"""Live events of a model over HTTP, and the thinning of rows for slow readers."""

import asyncio
from types import SimpleNamespace

import numpy as np
import pytest

from lipcore.online.batch import Rows
from lipcore.online.screening import PredictedBatch
from lipcore.vocabulary import Code
from service.contract.live import LiveRows, LiveStatus
from service.foundation.errors import NotFoundError
from service.learning.ingest.append import LoggedBatch
from service.learning.live import feed
from service.learning.live.feed import MAX_FOLLOWERS, MAX_UNREAD_EVENTS, Feed, FeedEvent, choose_rows, thin_batches
from service.learning.live.status import find_quantile_bound
from tests.service.data import error, eventually, service_of
from tests.service.learning.batches import make_rows
from tests.service.learning.event_listener import follow_model
from tests.service.learning.learning_models import BATCH_ROWS, observation_batch
from tests.service.server import Server
from tests.service.streams import TAU, frame, open_stream, read_hello


def test_live_rows_contain_predictions_made_before_learning(learning_service, learning_model):
    sent = {name: np.array(values) for name, values in observation_batch(0).items()}
    model = learning_service.service.loaded.get(learning_model.name, None).model
    before = model.predict(*(sent[name] for name in ("q", "dq", "ddq")))
    with follow_model(learning_service.client, learning_model.name) as listener:
        assert listener.status == 200
        assert listener.events[0][0] == "status"
        reply = learning_model.send_batches(0)
        eventually(lambda: listener.count_rows() == BATCH_ROWS)
        (part,) = listener.list_parts()
        LiveRows.model_validate({"parts": [part]})
        assert (part["stream_id"], part["version"], part["revision"]) == ("arm", 1, 0)
        assert part["counts"] == {"learnt": BATCH_ROWS}
        shown = len(part["time"])
        assert 1 <= shown <= BATCH_ROWS
        places = [int(np.abs(sent["tau"] - row).sum(axis=1).argmin()) for row in np.array(part["tau"])]
        assert places == sorted(set(places))
        for name, expected in (("tau", sent["tau"]), ("mean", before.tau), ("std", before.tau_std)):
            assert np.allclose(part[name], expected[places], atol=1e-6), name
        assert np.allclose(part["q"], sent["q"][places[-1]], atol=1e-6)
        assert part["noise_std"] == model.noise_std.tolist()
        total = np.sqrt(before.tau_std**2 + model.noise_std**2)
        worst = (np.abs(sent["tau"] - before.tau) / total).max(axis=0)
        assert np.allclose(part["worst"], worst, atol=2e-3)
        eventually(lambda: listener.list_data("status")[-1]["revision"] == reply["revision"])
        status = listener.list_data("status")[-1]
        LiveStatus.model_validate(status)
        assert status["counts"]["learnt"] == BATCH_ROWS
        assert status["counts"]["batches"] == 1
        assert status["windows"][0]["rows"] == status["windows"][0]["accepted"] == BATCH_ROWS
        assert (status["learns"], status["held"], status["alarms"], status["failure"]) == (True, None, [], None)
    assert service_of(learning_service.client).learners.live.open == 0


def test_readers_share_events_and_leave_no_state(learning_service, learning_model):
    client, name, feed = learning_model.client, learning_model.name, learning_service.service.learners.live
    learning_model.post("observations", observation_batch(0))
    assert name not in feed._followed
    with follow_model(client, name) as one, follow_model(client, name) as other:
        assert feed.open == 2
        learning_model.post("observations", observation_batch(1))
        eventually(lambda: one.count_rows() == other.count_rows() == BATCH_ROWS)
        assert one.list_data("rows") == other.list_data("rows")
        assert list(feed._followed) == [name]
    assert feed.open == 0
    assert not feed._followed


@pytest.mark.slow
def test_live_events_end_when_the_model_is_deleted(learning_model):
    with follow_model(learning_model.client, learning_model.name) as listener:
        assert learning_model.client.delete(f"/v1/models/{learning_model.name}").status_code == 204
        eventually(lambda: listener.ended)
    learning_model.expect_error("GET", "live", 404, "not_found")


def test_too_many_readers_are_rejected(learning_service, learning_model, monkeypatch):
    monkeypatch.setattr(type(learning_service.service.learners.live), "open", MAX_FOLLOWERS)
    answer = learning_model.client.get(learning_model.url("live"))
    error(answer, 429, "busy")
    assert int(answer.headers["retry-after"]) > 0


@pytest.mark.slow
def test_shutdown_ends_live_events(home):
    """In a process of its own, with a stream whose predictions are reported too."""
    with Server(home) as server:
        model = "/v1/models/panda-sim"
        with (
            open_stream(server, f"{model}/stream?stream_id=arm") as stream,
            server.client.stream("GET", f"{model}/live", timeout=30) as answer,
        ):
            assert answer.headers["content-type"].startswith("text/event-stream")
            lines = answer.iter_lines()
            assert next(lines) == "event: status"
            read_hello(stream)
            stream.send(frame(np.full((3, 7), 0.1), tau=np.resize(TAU, 7)))
            assert any(line == "event: rows" for line in lines)
            assert any('"answers":{' in line and '"count":1' in line for line in lines)
            server.process.terminate()
            for _ in lines:
                pass
        eventually(lambda: server.process.poll() is not None)


NOISE_NM = np.array([0.1, 0.2])


def make_served_model(revision=0):
    model = SimpleNamespace(noise_std=NOISE_NM, joint_names=("a", "b"))
    return SimpleNamespace(name="arm", version=1, revision=revision, model=model, base="base")


def make_logged_batch(count, codes=(), stream_id="one", of=None, seed=0, bare=0.05):
    """Return a batch whose mean is off by 0.5 N·m; rows with a code other than contact are not predicted."""
    found: Rows = make_rows(count, seed=seed, codes=codes)
    predicted = np.isin(found.code, (0, Code.CONTACT))
    mean = found.tau[predicted] - 0.5
    std, bare_std = np.full(mean.shape, 0.3), np.full(mean.shape, bare)
    rows = slice(0, count)
    screened = PredictedBatch(found, rows, predicted, predicted, mean, std, bare_std, NOISE_NM, 1, np.ones(2))
    return LoggedBatch(of or make_served_model(), stream_id, found, screened)


def test_thinning_prefers_rejected_rows():
    code = np.zeros(100, np.uint8)
    code[[37, 38, 80]] = Code.CONTACT
    chosen = choose_rows(code, 10)
    assert len(chosen) == 10
    assert {37, 80} <= set(chosen.tolist())
    assert 38 not in chosen


def test_parts_group_rows_by_stream_and_revision():
    first, second = make_served_model(0), make_served_model(1)
    batches = [
        make_logged_batch(20, of=first),
        make_logged_batch(20, ("contact", "limit", "edge"), of=first, seed=1),
        make_logged_batch(20, of=second, seed=2),
        make_logged_batch(40, stream_id="two", of=second),
    ]
    parts = thin_batches(batches, 10)
    reply = [(part.stream_id, part.revision, part.rows, len(part.time)) for part, _ in parts]
    assert reply == [("one", 0, 40, 4), ("one", 1, 20, 2), ("two", 1, 40, 4)]
    assert all(np.allclose(part.q, shown.rows.q[-1], atol=1e-6) for part, shown in parts)
    assert parts[0][0].counts == {"learnt": 37, "limit": 1, "contact": 1, "edge": 1}
    assert np.allclose(parts[0][0].worst, 0.5 / np.hypot(0.3, NOISE_NM), atol=1e-3)
    assert sum(len(part.time) for part, _ in thin_batches(batches, 1000)) == 99
    ((part, _),) = thin_batches([make_logged_batch(2, ("limit", "limit"))], 10)
    assert (part.worst, np.isnan(part.mean).all()) == ([None, None], True)  # rows that were not predicted


def test_novelty_checks_few_doubtful_rows(monkeypatch):
    checked_counts = []

    def uncovered(base, these):
        checked_counts.append(len(these))
        return np.arange(len(these)) % 2 == 0

    monkeypatch.setattr(feed, "uncovered", uncovered)
    logged = [
        *(make_logged_batch(20, seed=seed) for seed in range(4)),
        make_logged_batch(4, stream_id="two", bare=0.15),
        make_logged_batch(50, stream_id="three", bare=0.15),
    ]
    one, two, three = feed.find_novel_rows([thin_batches([batch], 100)[0][1] for batch in logged])
    assert checked_counts == [4, 17]
    assert (one.stream_id, one.times, one.unknown) == ("one", [], 0)
    assert (two.stream_id, len(two.times), two.unknown) == ("two", 2, 0)
    assert (len(three.times), three.unknown) == (9, 33)
    assert feed.find_novel_rows([]) == []


def test_latency_quantile_is_its_bucket_bound():
    bounds = (0.001, 0.01, 0.1)
    assert find_quantile_bound([0, 0, 0, 0], bounds, 0.5) is None
    assert find_quantile_bound([99, 1, 0, 0], bounds, 0.5) == 0.001
    assert find_quantile_bound([99, 1, 0, 0], bounds, 0.99) == 0.001
    assert find_quantile_bound([98, 1, 1, 0], bounds, 0.99) == 0.01
    assert find_quantile_bound([0, 0, 0, 5], bounds, 0.5) is None


class StatusStub:
    """Replacement for the status of a model."""

    calls = 0
    error: Exception | None = None

    def __call__(self, novel, passed):
        self.calls += 1
        if self.error is not None:
            raise self.error
        return SimpleNamespace(model_dump_json=lambda: f'{{"call":{self.calls}}}')


@pytest.fixture
def fast_feed(monkeypatch):
    monkeypatch.setattr(feed, "TICK_S", 0.01)
    return Feed()


async def wait_until(condition):
    while not condition():
        await asyncio.sleep(0.001)


def test_slow_reader_loses_oldest_events_with_notice(fast_feed):
    async def follow_feed():
        closing = asyncio.Event()
        events = fast_feed.follow("arm", StatusStub(), closing)
        first = await anext(events)
        assert first == FeedEvent("status", '{"call":1}')
        (reader,) = fast_feed._followed["arm"].readers
        for number in range(MAX_UNREAD_EVENTS + 5):
            reader.put(FeedEvent("rows", str(number)))
        assert await anext(events) == FeedEvent("lost", '{"events":5}')
        assert (await anext(events)).data == "5"
        closing.set()
        assert [event.data async for event in events if event.event == "rows"][-1] == str(MAX_UNREAD_EVENTS + 4)
        assert not fast_feed._followed

    asyncio.run(follow_feed())


def test_status_errors_do_not_end_the_feed_but_deletion_does(fast_feed, monkeypatch):
    monkeypatch.setattr(feed, "STATUS_S", 0.0)

    async def follow_feed():
        look = StatusStub()
        events = fast_feed.follow("arm", look, asyncio.Event())
        await anext(events)
        look.error = OSError("disk")
        await wait_until(lambda: look.calls > 3)
        look.error = None
        calls = look.calls
        assert (await anext(events)).event == "status"
        await wait_until(lambda: look.calls > calls)
        look.error = NotFoundError("gone")
        rest = [event async for event in events]
        assert all(event.event == "status" for event in rest)
        assert not fast_feed._followed

    asyncio.run(follow_feed())
