"""Queries that ask for a revision at least: answered once it is there, by the version that has it, or refused."""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from service.models.served import Waiting
from tests.service.data import error, service_of
from tests.service.learning.lessons import QUERIES, lesson

SINGLE = {name: rows[0] for name, rows in QUERIES.items()}


@pytest.fixture
def pupil(school, request):
    """A model for each test."""
    return school.enrol("waiting-" + request.node.name.replace("_", "-")[-40:])


def test_what_was_taught_is_in_the_answer(pupil):
    pupil.predict()
    said = pupil.post("observations", lesson(0))
    with ThreadPoolExecutor(2) as threads:  # through the event loop, which goes on, and through a thread
        asked = [
            threads.submit(pupil.client.post, pupil.url("predict"), json=query | {"min_revision": said["revision"]})
            for query in (SINGLE, QUERIES)
        ]
        answers = [each.result() for each in asked]
    # a learner that is only started may take longer than they wait
    assert all(each.status_code in (200, 503) for each in answers)
    pupil.settled(said["revision"])
    for query in (SINGLE, QUERIES):
        assert pupil.post("predict", query | {"min_revision": said["revision"]})["revision"] == said["revision"]


def test_a_revision_that_does_not_come_is_refused(pupil, monkeypatch):
    woken = []
    monkeypatch.setattr(service_of(pupil.client).loaded, "_wake", woken.append)
    monkeypatch.setitem(vars(service_of(pupil.client).settings), "min_revision_wait_s", 0.05)
    for query in (SINGLE, QUERIES):
        woken.clear()
        answer = pupil.client.post(pupil.url("predict"), json=query | {"min_revision": 3})
        (item,) = error(answer, 503, "revision_not_reached")["detail"]
        assert item == {"field": "min_revision", "value": "3", "expected": "0 or less now, of version 1"}
        assert answer.headers["retry-after"] == "1"
        assert woken == [pupil.model]  # once: who has logged it may have told nobody


def test_a_data_set_is_compared_with_what_was_taught(pupil, monkeypatch):
    monkeypatch.setitem(vars(service_of(pupil.client).settings), "min_revision_wait_s", 0.05)
    body = {"dataset": "ds_0", "min_revision": 1}
    error(pupil.client.post(pupil.url("evaluate"), json=body), 503, "revision_not_reached")
    pupil.refused("POST", "evaluate", 404, "not_found", json=body | {"min_revision": 0})


def test_what_is_not_there_is_not_waited_for(school, pupil):
    pupil.refused("POST", "predict", 404, "not_found", json=QUERIES | {"min_revision": 1, "version": 9})
    answer = school.client.post("/v1/models/nobody/predict", json=QUERIES | {"min_revision": 1})
    error(answer, 404, "not_found")


def test_a_waiter_misses_nothing_and_leaves_nothing():
    waiting = Waiting()

    async def wait() -> None:
        with waiting.waiter("arm") as first, waiting.waiter("arm") as second:
            waiting.wake("other")
            thread = threading.Thread(target=waiting.wake, args=("arm",))
            thread.start()
            thread.join()
            await asyncio.gather(first.wait(60.0), second.wait(60.0))  # told before they wait
            await first.wait(0.0)  # told once

    asyncio.run(wait())
    assert waiting._waiters == {}
    waiting.wake("arm")
