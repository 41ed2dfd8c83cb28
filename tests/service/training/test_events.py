"""Server-sent events of a job: from its present state to its end, for any number of readers."""

import asyncio
from itertools import pairwise
from unittest.mock import Mock, call

import pytest

from service.training import feed
from service.training.feed import MAX_FOLLOWERS, JobEventStream
from tests.service.data import error, queue, service_of, stream, upload
from tests.service.learning.event_listener import EventListener, follow_events

FAST_OPTIONS = {"hyperparameter_samples": 20, "posterior_samples": 30, "max_iterations": 2}


def read(text):
    """Return the events of a stream as pairs (kind, data)."""
    listener = EventListener()
    asyncio.run(listener.send({"type": "http.response.body", "body": text.encode()}))
    return listener.events


def test_job_is_followed_from_start_to_end(api, pendulum):
    name = queue(api, "followed", pendulum["id"])["id"]
    answer = api.get(f"/v1/jobs/{name}/events")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/event-stream")
    assert answer.headers["cache-control"] == "no-cache"
    events = read(answer.text)
    assert events[0][0] == events[-1][0] == "state"
    assert {data["id"] for _, data in events} == {name}
    assert {kind for kind, _ in events} <= {"state", "progress"}
    last = events[-1][1]
    assert (last["state"], last["version"], last["progress"]["fraction"]) == ("succeeded", 1, 1.0)
    assert [entry["state"] for entry in last["history"]] == ["queued", "running", "succeeded"]
    assert last == api.get(f"/v1/jobs/{name}").json()
    for (_, before), (kind, after) in pairwise(events):
        assert (kind == "state") == (before["history"] != after["history"])
        assert kind == "state" or before["progress"] != after["progress"]

    assert read(api.get(f"/v1/jobs/{name}/events").text) == [("state", last)]  # the job has ended
    assert service_of(api).jobs.feed.open == 0


@pytest.fixture
def waiting(no_worker):
    """The path of the events of a job that stays queued."""
    name = queue(no_worker, "waiting", upload(no_worker, stream())["id"], options=FAST_OPTIONS)["id"]
    yield f"/v1/jobs/{name}/events"
    no_worker.post(f"/v1/jobs/{name}/cancel")


def test_number_of_readers_is_limited(no_worker, waiting, monkeypatch):
    monkeypatch.setattr(type(service_of(no_worker).jobs.feed), "open", MAX_FOLLOWERS)
    answer = no_worker.get(waiting)
    error(answer, 429, "busy")
    assert int(answer.headers["retry-after"]) > 0


def test_reader_that_leaves_is_forgotten(no_worker, waiting):
    with follow_events(no_worker, waiting) as listener:
        assert listener.status == 200
        assert listener.list_data("state")[0]["state"] == "queued"
    assert service_of(no_worker).jobs.feed.open == 0
    assert not service_of(no_worker).jobs.feed._followers


@pytest.fixture
def following(table, monkeypatch):
    """A stream that often reads a table with one job."""
    monkeypatch.setattr(feed, "CHECK_S", 0.01)
    table.add("x")
    return JobEventStream(table.database)


async def until_read(following):
    while "job_x" not in following._rows:
        await asyncio.sleep(0.001)


def test_many_readers_share_one_query(table, following, monkeypatch):
    """Each reader sees every lasting change, even if it comes late or its first row is stale."""
    look = Mock(wraps=following._read_rows)
    monkeypatch.setattr(following, "_read_rows", look)

    async def follow_until(state, row):
        async for seen in following.follow(row, closing):
            if seen.state == state:
                return seen.id

    async def run_readers():
        stale = table.row("job_x")
        early = [asyncio.create_task(follow_until("running", stale)) for _ in range(20)]
        while not look.called:
            await asyncio.sleep(0)
        table.change("job_x", state="running")
        assert await asyncio.gather(*early) == ["job_x"] * 20

        stay = asyncio.create_task(follow_until("succeeded", stale))
        await until_read(following)
        # the row does not change any more, but it was read before
        assert await follow_until("running", stale) == "job_x"
        table.change("job_x", state="succeeded")
        assert await stay == "job_x"

    closing = asyncio.Event()
    asyncio.run(run_readers())
    assert not following._followers
    assert not following._rows
    assert all(each == call(["job_x"]) for each in look.call_args_list)


def test_readers_end_when_the_service_closes(table, following):
    async def read_states(closing):
        return [seen.state async for seen in following.follow(table.row("job_x"), closing)]

    async def run_readers():
        closing = asyncio.Event()
        tasks = [asyncio.create_task(read_states(closing)) for _ in range(3)]
        await until_read(following)
        closing.set()
        assert all(states[0] == "queued" for states in await asyncio.gather(*tasks))

    asyncio.run(run_readers())
