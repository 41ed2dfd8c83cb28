"""Server-sent events of a job: from its present state to its end, for any number of readers."""

import asyncio
import json
from itertools import pairwise

import pytest
from sqlalchemy import select

from service.foundation.settings import Settings
from service.storage.database import Database, JobRow
from service.training import feed
from service.training.feed import MAX_FOLLOWERS, JobEventStream
from tests.service.data import error, queue, service_of, stream, upload
from tests.service.learning.event_listener import follow_events
from tests.service.training.conftest import new_row


def read(text):
    """Return the events of a stream as pairs (kind, data)."""
    found = []
    for block in text.strip().split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines() if not line.startswith(":"))
        if fields:
            found.append((fields["event"], json.loads(fields["data"])))
    return found


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


def test_number_of_readers_is_limited(no_worker, monkeypatch):
    name = queue(no_worker, "many", upload(no_worker, stream())["id"], options={**FAST_OPTIONS})["id"]
    many = service_of(no_worker).jobs.feed
    monkeypatch.setattr(many, "open", MAX_FOLLOWERS)
    answer = no_worker.get(f"/v1/jobs/{name}/events")
    error(answer, 429, "busy")
    assert int(answer.headers["retry-after"]) > 0
    no_worker.post(f"/v1/jobs/{name}/cancel")


FAST_OPTIONS = {"hyperparameter_samples": 20, "posterior_samples": 30, "max_iterations": 2}


def test_reader_that_leaves_is_forgotten(no_worker):
    name = queue(no_worker, "left", upload(no_worker, stream())["id"], options=FAST_OPTIONS)["id"]
    with follow_events(no_worker, f"/v1/jobs/{name}/events") as listener:
        assert listener.status == 200
        assert listener.list_data("state")[0]["state"] == "queued"
    assert service_of(no_worker).jobs.feed.open == 0
    assert not service_of(no_worker).jobs.feed._followers
    no_worker.post(f"/v1/jobs/{name}/cancel")


@pytest.fixture
def job_row(home, monkeypatch):
    """A database of its own with one job, which a stream reads often."""
    monkeypatch.setattr(feed, "LOOK_S", 0.01)
    database = Database.of(Settings(home=home))
    with database.transaction() as session:
        session.add(new_row("x"))
    yield database
    database.close()


def change(database, **values):
    with database.transaction() as session:
        row = session.scalar(select(JobRow).where(JobRow.id == "job_x"))
        for name, value in values.items():
            setattr(row, name, value)


def row_of(database):
    with database.session() as session:
        return session.scalar(select(JobRow).where(JobRow.id == "job_x"))


def test_many_readers_share_one_query(job_row, monkeypatch):
    """Each reader sees every lasting change, even if it comes late or its first row is stale."""
    following, looks = JobEventStream(job_row), []
    look = following._look
    monkeypatch.setattr(following, "_look", lambda jobs: (looks.append(jobs), look(jobs))[1])

    async def follow_until(state, row):
        async for seen in following.follow(row, closing):
            if seen.state == state:
                return seen.id

    async def run_readers():
        stale = row_of(job_row)
        early = [asyncio.create_task(follow_until("running", stale)) for _ in range(20)]
        while not looks:
            await asyncio.sleep(0)
        change(job_row, state="running")
        assert await asyncio.gather(*early) == ["job_x"] * 20

        stay = asyncio.create_task(follow_until("succeeded", stale))
        while "job_x" not in following._rows:
            await asyncio.sleep(0.001)
        # the row does not change any more, but it was read before
        assert await follow_until("running", stale) == "job_x"
        change(job_row, state="succeeded")
        assert await stay == "job_x"

    closing = asyncio.Event()
    asyncio.run(run_readers())
    assert not following._followers
    assert not following._rows
    assert all(jobs == ["job_x"] for jobs in looks)


def test_readers_end_when_the_service_closes(job_row):
    async def run_readers():
        closing = asyncio.Event()
        following = JobEventStream(job_row)

        async def read_states():
            return [seen.state async for seen in following.follow(row_of(job_row), closing)]

        tasks = [asyncio.create_task(read_states()) for _ in range(3)]
        while "job_x" not in following._rows:
            await asyncio.sleep(0.001)
        closing.set()
        assert all(states[0] == "queued" for states in await asyncio.gather(*tasks))

    asyncio.run(run_readers())
