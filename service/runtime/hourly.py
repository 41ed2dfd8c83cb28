"""Hourly chores of a running service: each deletes rows or files that are too old."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager

from anyio import to_thread

logger = logging.getLogger(__name__)

EVERY_S = 3600.0
"""Seconds between two runs of the chores."""


@asynccontextmanager
async def run_hourly(chores: Mapping[str, Callable[[], object]]) -> AsyncIterator[None]:
    """Run chores every hour during the block, one after the other, in a thread.

    chores: functions by what they delete, for the log. A chore that fails is tried again an hour later.
    """
    task = asyncio.create_task(_run(chores))
    try:
        yield
    finally:
        task.cancel()
        await asyncio.wait((task,))


async def _run(chores: Mapping[str, Callable[[], object]]) -> None:
    while True:
        await asyncio.sleep(EVERY_S)  # wait first, so that a host with a wrong clock at its start has corrected it
        for name, chore in chores.items():
            try:
                await to_thread.run_sync(chore)
            except Exception as error:
                logger.warning("could not delete old %s: %s", name, error)
