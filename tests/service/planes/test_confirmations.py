"""Answers wait for the data plane: each part after the changes before it, and not for long."""

import asyncio
from math import inf

import pytest

from service.models.changes import Changes
from service.planes import confirmations
from service.planes.confirmations import Confirmations, ReadYourWrites

pytestmark = pytest.mark.anyio
START, BODY = {"type": "http.response.start", "status": 200}, {"type": "http.response.body", "body": b""}


async def answer(known, changes, kind="http", change=True):
    """Answer a request that changes something; return its messages, which appear as they are sent."""
    sent = []

    async def app(scope, receive, send):
        if change:
            changes.note()
        await send(START)
        await send(BODY)

    async def send(message):
        sent.append(message)

    task = asyncio.create_task(ReadYourWrites(app, known)({"type": kind}, None, send))
    await asyncio.sleep(0)
    return task, sent


@pytest.fixture
def patient(monkeypatch):
    """Wait for as long as a test lasts."""
    monkeypatch.setattr(confirmations, "MAX_WAIT_S", 60.0)


def watching():
    """Return confirmations and the changes that they count."""
    known, changes = Confirmations(), Changes()
    known.watch(changes)
    return known, changes


async def confirm_later(known, number):
    """Confirm a number from another thread, and let the event loop see it."""
    await asyncio.to_thread(known.confirm, number)
    for _ in range(3):
        await asyncio.sleep(0)


async def test_answers_leave_after_the_changes_before_them(patient):
    known, changes = watching()
    known.confirm(0)
    task, sent = await answer(known, changes)
    assert sent == []
    changes.note()  # a later change of another request is not waited for
    await confirm_later(known, 0)
    assert sent == []
    await confirm_later(known, 1)
    assert sent == [START]  # the next part waits for what has changed since
    await confirm_later(known, 2)
    await task
    assert sent == [START, BODY]


async def test_answers_without_changes_leave_at_once(patient):
    known, changes = watching()
    known.confirm(0)
    task, sent = await answer(known, changes, change=False)
    assert sent == [START, BODY]
    await task


@pytest.mark.parametrize("number", [inf, 5])
async def test_nothing_is_waited_for_without_a_data_plane_or_after_its_confirmation(patient, number):
    known, changes = watching()
    known.confirm(number)
    task, sent = await answer(known, changes)
    assert sent == [START, BODY]
    await task


async def test_end_of_the_data_plane_ends_the_wait(patient):
    known, changes = watching()
    known.confirm(0)
    task, sent = await answer(known, changes)
    assert sent == []
    await confirm_later(known, inf)
    await task
    assert sent == [START, BODY]


async def test_hanging_data_plane_is_not_waited_for_any_longer(monkeypatch):
    monkeypatch.setattr(confirmations, "MAX_WAIT_S", 0.01)
    known, changes = watching()
    known.confirm(0)
    task, sent = await answer(known, changes)
    assert sent == []
    await task
    assert sent == [START, BODY]
    assert known.are_missing


async def test_cancelled_requests_wait_no_longer(patient):
    known, changes = watching()
    known.confirm(0)
    task, sent = await answer(known, changes)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    await confirm_later(known, 1)
    assert sent == []


async def test_start_of_the_application_does_not_wait(patient):
    known, changes = watching()
    known.confirm(0)
    task, sent = await answer(known, changes, kind="lifespan")
    assert sent == [START, BODY]
    await task
