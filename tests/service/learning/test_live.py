"""A model that is followed live: its events over HTTP, and what is picked of many rows for slow readers."""

import asyncio
from types import SimpleNamespace

import numpy as np
import pytest

from lipcore.online.batch import Rows
from lipcore.online.screening import PredictedBatch
from lipcore.vocabulary import Code
from service.contract.learning import LiveRows, LiveStatus
from service.foundation.errors import NotFoundError
from service.learning.ingest.append import LoggedBatch
from service.learning.live import feed
from service.learning.live.feed import MAX_FOLLOWERS, MAX_UNREAD_EVENTS, Feed, FeedEvent, choose_rows, thin_batches
from service.learning.live.look import find_quantile_bound
from tests.service.data import error, eventually, service_of
from tests.service.learning.batches import rows
from tests.service.learning.following import following
from tests.service.learning.lessons import LESSON, lesson
from tests.service.server import Server
from tests.service.streams import TAU, dial, frame, hello


def test_rows_are_told_with_what_was_predicted_before_they_were_learnt(school):
    pupil = school.enrol("seen")
    sent = lesson(0)
    model = school.service.loaded.get("seen", None).model
    before = model.predict(*(np.array(sent[name]) for name in ("q", "dq", "ddq")))
    with following(school.client, "seen") as listener:
        assert listener.status == 200
        assert listener.events[0][0] == "status"
        said = pupil.teach(0)
        eventually(lambda: listener.rows() == LESSON)
        (part,) = listener.parts()
        LiveRows.model_validate({"parts": [part]})
        assert (part["stream_id"], part["version"], part["revision"]) == ("arm", 1, 0)
        assert part["counts"] == {"learnt": LESSON}
        shown = len(part["time"])
        assert 1 <= shown <= LESSON
        places = [int(np.abs(np.array(sent["tau"]) - row).sum(axis=1).argmin()) for row in np.array(part["tau"])]
        assert places == sorted(set(places))
        for name, expected in (("tau", np.array(sent["tau"])), ("mean", before.tau), ("std", before.tau_std)):
            assert np.allclose(part[name], expected[places], atol=1e-6), name
        assert np.allclose(part["q"], np.array(sent["q"])[places[-1]], atol=1e-6)
        assert part["noise_std"] == model.noise_std.tolist()
        total = np.sqrt(before.tau_std**2 + model.noise_std**2)
        worst = (np.abs(np.array(sent["tau"]) - before.tau) / total).max(axis=0)
        assert np.allclose(part["worst"], worst, atol=2e-3)
        status = eventually(lambda: (last := listener.of("status")[-1])["revision"] == said["revision"] and last)
        LiveStatus.model_validate(status)
        assert status["counts"]["learnt"] == LESSON
        assert status["counts"]["batches"] == 1
        assert status["windows"][0]["rows"] == status["windows"][0]["accepted"] == LESSON
        assert (status["learns"], status["held"], status["alarms"], status["failure"]) == (True, None, [], None)
    assert service_of(school.client).learners.live.open == 0


def test_readers_share_what_is_told_and_nothing_is_kept_without_them(school):
    pupil = school.enrol("shared")
    feed = school.service.learners.live
    pupil.post("observations", lesson(0))
    assert "shared" not in feed._followed
    with following(school.client, "shared") as one, following(school.client, "shared") as other:
        assert feed.open == 2
        pupil.post("observations", lesson(1))
        eventually(lambda: one.rows() == other.rows() == LESSON)
        assert one.of("rows") == other.of("rows")
        assert list(feed._followed) == ["shared"]
    assert feed.open == 0
    assert not feed._followed


def test_following_ends_when_the_model_is_deleted(school):
    school.enrol("short-lived")
    with following(school.client, "short-lived") as listener:
        assert school.client.delete("/v1/models/short-lived").status_code == 204
        eventually(lambda: listener.ended)
    error(school.client.get("/v1/models/short-lived/live"), 404, "not_found")


def test_no_more_readers_than_may_be(school, monkeypatch):
    school.enrol("crowded")
    monkeypatch.setattr(school.service.learners.live, "open", MAX_FOLLOWERS)
    answer = school.client.get("/v1/models/crowded/live")
    error(answer, 429, "busy")
    assert int(answer.headers["retry-after"]) > 0


@pytest.mark.slow
def test_a_service_that_is_told_to_stop_ends_the_events(home):
    """In a process of its own, with a stream: its answers are told too."""
    with Server(home) as server:
        model = "/v1/models/panda-sim"
        with (
            dial(server, f"{model}/stream?stream_id=arm") as stream,
            server.client.stream("GET", f"{model}/live", timeout=30) as answer,
        ):
            assert answer.headers["content-type"].startswith("text/event-stream")
            lines = answer.iter_lines()
            assert next(lines) == "event: status"
            hello(stream)
            stream.send(frame(np.full((3, 7), 0.1), tau=np.resize(TAU, 7)))
            assert any(line == "event: rows" for line in lines)
            assert any('"answers":{' in line and '"count":1' in line for line in lines)
            server.process.terminate()
            for _ in lines:
                pass
        eventually(lambda: server.process.poll() is not None)


def served(revision=0, noise=(0.1, 0.2)):
    model = SimpleNamespace(noise_std=np.array(noise), joint_names=("a", "b"))
    return SimpleNamespace(name="arm", version=1, revision=revision, model=model, base="base")


def judged(count=4, codes=(), stream_id="one", of=None, seed=0, bare=0.05):
    """A batch whose rows with a code, contacts aside, were not predicted; each mean is half a torque away."""
    found: Rows = rows(count, seed=seed, codes=codes)
    predicted = np.isin(found.code, (0, Code.CONTACT))
    mean = found.tau[predicted] - 0.5
    std = np.full(mean.shape, 0.3)
    noise = np.array([0.1, 0.2])
    screened = PredictedBatch(
        found, slice(0, count), predicted, predicted, mean, std, np.full(mean.shape, bare), noise, 1, np.ones(2)
    )
    return LoggedBatch(of or served(), stream_id, found, screened)


def test_a_row_that_was_kept_out_stands_for_its_stretch():
    code = np.zeros(100, np.uint8)
    code[[37, 38, 80]] = Code.CONTACT
    chosen = choose_rows(code, 10)
    assert len(chosen) == 10
    assert {37, 80} <= set(chosen.tolist())
    assert 38 not in chosen


def test_parts_are_of_one_stream_and_revision_and_count_all_rows():
    first, second = served(0), served(1)
    batches = [
        judged(20, of=first),
        judged(20, ("contact", "limit", "edge"), of=first, seed=1),
        judged(20, of=second, seed=2),
        judged(40, stream_id="two", of=second),
    ]
    parts = thin_batches(batches, 10)
    said = [(part.stream_id, part.revision, part.rows, len(part.time)) for part, _ in parts]
    assert said == [("one", 0, 40, 4), ("one", 1, 20, 2), ("two", 1, 40, 4)]
    assert all(np.allclose(part.q, shown.rows.q[-1], atol=1e-6) for part, shown in parts)
    assert parts[0][0].counts == {"learnt": 37, "limit": 1, "contact": 1, "edge": 1}
    assert np.allclose(parts[0][0].worst, 0.5 / np.hypot(0.3, [0.1, 0.2]), atol=1e-3)
    assert sum(len(part.time) for part, _ in thin_batches(batches, 1000)) == 99
    ((part, _),) = thin_batches([judged(2, ("limit", "limit"))], 10)
    assert (part.worst, np.isnan(part.mean).all()) == ([None, None], True)  # of rows that were not predicted


def test_only_doubtful_rows_are_looked_at_and_not_too_many(monkeypatch):
    looked = []

    def uncovered(base, these):
        looked.append(len(these))
        return np.arange(len(these)) % 2 == 0

    monkeypatch.setattr(feed, "uncovered", uncovered)
    gathered = []
    for seed in range(4):
        gathered.append(thin_batches([judged(20, seed=seed, bare=0.05)], 100)[0][1])
    gathered.append(thin_batches([judged(4, stream_id="two", bare=0.15)], 100)[0][1])
    gathered.append(thin_batches([judged(50, stream_id="three", bare=0.15)], 100)[0][1])
    one, two, three = feed.find_novel_rows(gathered)
    assert looked == [4, 17]
    assert (one.stream_id, one.times, one.unknown) == ("one", [], 0)
    assert (two.stream_id, len(two.times), two.unknown) == ("two", 2, 0)
    assert (len(three.times), three.unknown) == (9, 33)
    assert feed.find_novel_rows([]) == []


def test_latency_is_told_by_the_bound_of_its_bucket():
    bounds = (0.001, 0.01, 0.1)
    assert find_quantile_bound([0, 0, 0, 0], bounds, 0.5) is None
    assert find_quantile_bound([99, 1, 0, 0], bounds, 0.5) == 0.001
    assert find_quantile_bound([99, 1, 0, 0], bounds, 0.99) == 0.001
    assert find_quantile_bound([98, 1, 1, 0], bounds, 0.99) == 0.01
    assert find_quantile_bound([0, 0, 0, 5], bounds, 0.5) is None


class Look:
    """Stands for the status of a model."""

    def __init__(self):
        self.calls = 0
        self.error = None

    def __call__(self, novel, passed):
        self.calls += 1
        if self.error is not None:
            raise self.error
        return SimpleNamespace(model_dump_json=lambda: f'{{"call":{self.calls}}}')


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(feed, "TICK_S", 0.01)
    return Feed()


async def until(condition):
    while not condition():
        await asyncio.sleep(0.001)


def test_a_slow_reader_loses_the_oldest_and_is_told(quick):
    async def story():
        closing = asyncio.Event()
        events = quick.follow("arm", Look(), closing)
        first = await anext(events)
        assert first == FeedEvent("status", '{"call":1}')
        (reader,) = quick._followed["arm"].readers
        for number in range(MAX_UNREAD_EVENTS + 5):
            reader.put(FeedEvent("rows", str(number)))
        assert await anext(events) == FeedEvent("lost", '{"events":5}')
        assert (await anext(events)).data == "5"
        closing.set()
        assert [said.data async for said in events if said.event == "rows"][-1] == str(MAX_UNREAD_EVENTS + 4)
        assert not quick._followed

    asyncio.run(story())


def test_an_error_of_a_look_is_no_end_but_a_deleted_model_is(quick, monkeypatch):
    monkeypatch.setattr(feed, "STATUS_S", 0.0)

    async def story():
        look = Look()
        events = quick.follow("arm", look, asyncio.Event())
        await anext(events)
        look.error = OSError("disk")
        await until(lambda: look.calls > 3)
        look.error = None
        calls = look.calls
        assert (await anext(events)).event == "status"
        await until(lambda: look.calls > calls)
        look.error = NotFoundError("gone")
        rest = [said async for said in events]
        assert all(said.event == "status" for said in rest)
        assert not quick._followed

    asyncio.run(story())
