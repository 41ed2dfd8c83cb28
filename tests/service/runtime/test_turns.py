"""The limit on concurrent computations: waiting callers can be cancelled, running ones keep their place."""

import asyncio
import threading

import pytest
from anyio import CapacityLimiter

from service.api.limits.requests import in_turn
from tests.service.data import DEADLINE


async def wait_until(look):
    async with asyncio.timeout(DEADLINE):
        while not look():
            await asyncio.sleep(0.001)


def test_cancelled_caller_keeps_a_running_turn_and_drops_a_waiting_one():
    begun, go, computed = threading.Event(), threading.Event(), []

    def slow():
        begun.set()
        go.wait(DEADLINE)
        computed.append("slow")
        raise ValueError("nobody waits for it")

    async def run():
        turns = CapacityLimiter(1)
        asking = asyncio.create_task(in_turn(turns, slow))
        await wait_until(begun.is_set)
        asking.cancel()
        with pytest.raises(asyncio.CancelledError):
            await asking
        assert turns.borrowed_tokens == 1
        waiting = asyncio.create_task(in_turn(turns, computed.append, "given up"))
        await wait_until(lambda: turns.statistics().tasks_waiting == 1)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        last = asyncio.create_task(in_turn(turns, computed.append, "last"))
        await wait_until(lambda: turns.statistics().tasks_waiting == 1)
        assert computed == []
        go.set()
        await last
        assert computed == ["slow", "last"]
        assert turns.borrowed_tokens == 0

    asyncio.run(run())
