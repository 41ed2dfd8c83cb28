"""The parts of the live feed by themselves: what is picked of many rows, slow readers, ends."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lipcore.online.batch import Rows
from lipcore.vocabulary import CODES
from service.foundation.errors import BusyError, NotFoundError
from service.foundation.settings import Settings
from service.learning.ingest.intake import Judged
from service.learning.ingest.screening import Screened
from service.learning.live import feed
from service.learning.live.feed import MOST_UNREAD, Feed, FeedEvent, pick, thinned
from service.learning.live.routes import at_most
from tests.service.learning.batches import rows

CONTACT, EDGE = CODES.index("contact"), CODES.index("edge")


def served(revision=0, noise=(0.1, 0.2)):
    model = SimpleNamespace(noise_std=np.array(noise), joint_names=("a", "b"))
    return SimpleNamespace(name="arm", version=1, revision=revision, model=model, base="base")


def judged(count=4, codes=(), stream_id="one", of=None, seed=0, bare=0.05):
    """A batch whose rows with a code, contacts aside, were not predicted; each mean is half a torque away."""
    found: Rows = rows(count, seed=seed, codes=codes)
    predicted = np.isin(found.code, (0, CONTACT))
    mean = found.tau[predicted] - 0.5
    std = np.full(mean.shape, 0.3)
    noise = np.array([0.1, 0.2])
    screened = Screened(found, slice(0, count), None, predicted, mean, std, np.full(mean.shape, bare), noise)
    return Judged(of or served(), stream_id, found, screened)


@pytest.mark.parametrize("most", [1, 3, 10, 99, 100, 1000])
def test_rows_are_picked_evenly(most):
    chosen = pick(np.zeros(100, np.uint8), most)
    assert len(chosen) == min(most, 100)
    assert (np.diff(chosen) > 0).all()
    assert np.ptp(np.diff(chosen)) <= 1 if most > 2 else True


def test_a_row_that_was_kept_out_stands_for_its_stretch():
    code = np.zeros(100, np.uint8)
    code[[37, 38, 80]] = CONTACT
    chosen = pick(code, 10)
    assert len(chosen) == 10
    assert {37, 80} <= set(chosen.tolist())
    assert 38 not in chosen


def test_rows_at_an_edge_are_left_out():
    code = np.array([EDGE, 0, 0, EDGE], np.uint8)
    assert pick(code, 10).tolist() == [1, 2]
    assert pick(np.full(3, EDGE, np.uint8), 10).tolist() == []


def test_parts_are_of_one_stream_and_revision_and_count_all_rows():
    first, second = served(0), served(1)
    batches = [
        judged(20, of=first),
        judged(20, ("contact", "limit", "edge"), of=first, seed=1),
        judged(20, of=second, seed=2),
        judged(40, stream_id="two", of=second),
    ]
    parts = thinned(batches, 10)
    said = [(part.stream_id, part.revision, part.rows, len(part.time)) for part, _ in parts]
    assert said == [("one", 0, 40, 4), ("one", 1, 20, 2), ("two", 1, 40, 4)]
    assert all(np.allclose(part.q, shown.rows.q[-1], atol=1e-6) for part, shown in parts)
    assert parts[0][0].counts == {"learnt": 37, "limit": 1, "contact": 1, "edge": 1}
    assert np.allclose(parts[0][0].worst, 0.5 / np.hypot(0.3, [0.1, 0.2]), atol=1e-3)
    assert sum(len(part.time) for part, _ in thinned(batches, 1000)) == 99


def test_rows_that_were_not_predicted_have_no_prediction():
    ((part, shown),) = thinned([judged(3, ("limit",))], 10)
    assert part.code == ["limit", "learnt", "learnt"]
    assert np.isnan(shown.mean[0]).all()
    assert '"mean":[[null,null],[' in part.model_dump_json()
    ((part, _),) = thinned([judged(2, ("limit", "limit"))], 10)
    assert part.worst == [None, None]


def test_only_doubtful_rows_are_looked_at_and_not_too_many(monkeypatch):
    looked = []

    def uncovered(base, these):
        looked.append(len(these))
        return np.arange(len(these)) % 2 == 0

    monkeypatch.setattr(feed, "uncovered", uncovered)
    gathered = []
    for seed in range(4):
        gathered.append(thinned([judged(20, seed=seed, bare=0.05)], 100)[0][1])
    gathered.append(thinned([judged(4, stream_id="two", bare=0.15)], 100)[0][1])
    gathered.append(thinned([judged(50, stream_id="three", bare=0.15)], 100)[0][1])
    one, two, three = feed.beyond(gathered)
    assert looked == [4, 17]
    assert (one.stream_id, one.times, one.unknown) == ("one", [], 0)
    assert (two.stream_id, len(two.times), two.unknown) == ("two", 2, 0)
    assert (len(three.times), three.unknown) == (9, 33)
    assert feed.beyond([]) == []


def test_latency_is_told_by_the_bound_of_its_bucket():
    bounds = (0.001, 0.01, 0.1)
    assert at_most([0, 0, 0, 0], bounds, 0.5) is None
    assert at_most([99, 1, 0, 0], bounds, 0.5) == 0.001
    assert at_most([99, 1, 0, 0], bounds, 0.99) == 0.001
    assert at_most([98, 1, 1, 0], bounds, 0.99) == 0.01
    assert at_most([0, 0, 0, 5], bounds, 0.5) is None


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
    return Feed(Settings())


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
        for number in range(MOST_UNREAD + 5):
            reader.put(FeedEvent("rows", str(number)))
        assert await anext(events) == FeedEvent("lost", '{"events":5}')
        assert (await anext(events)).data == "5"
        closing.set()
        assert [said.data async for said in events if said.event == "rows"][-1] == str(MOST_UNREAD + 4)
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


def test_batches_are_noted_only_while_somebody_follows(quick):
    async def story():
        closing = asyncio.Event()
        quick.note(judged())
        events = quick.follow("arm", Look(), closing)
        await anext(events)
        other = replace(judged().rows)
        quick.note(judged(7)._replace(rows=other) if len(other) == 7 else judged(7))
        said = await anext(events)
        assert said.event == "rows"
        assert '"rows":7' in said.data
        task = quick._followed["arm"].task
        await events.aclose()
        assert not quick._followed
        await asyncio.wait_for(task, 5)
        quick.note(judged())

    asyncio.run(story())


def test_readers_are_counted(quick):
    with quick.one_more(1):
        with pytest.raises(BusyError, match="1 times"), quick.one_more(1):
            pass
        assert quick.open == 1
    assert quick.open == 0
