"""Publish changes of jobs to any number of followers, with one database query for all of them."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import suppress
from contextvars import Context
from typing import ClassVar

from anyio import to_thread
from sqlalchemy import select

from service.runtime.counted import OpenCounter
from service.storage.database import Database, JobRow

logger = logging.getLogger(__name__)

CHECK_S = 0.4
"""Interval between two reads of the followed jobs, s."""
MAX_FOLLOWERS = 100
"""Maximum event streams of jobs at a time; further requests are answered 429."""


class JobEventStream(OpenCounter):
    """Followers of jobs; belongs to the event loop."""

    too_many = "{} event streams of jobs are open, the max: close one, or retry later"
    headers: ClassVar = {"Retry-After": "5"}

    def __init__(self, database: Database) -> None:
        super().__init__()
        self.database = database
        self._rows: dict[str, JobRow] = {}
        self._followers: dict[str, list[asyncio.Event]] = {}
        self._reader: asyncio.Task[None] | None = None

    async def follow(self, row: JobRow, closing: asyncio.Event) -> AsyncIterator[JobRow]:
        """Yield the row, then again after each change, until the service closes. The caller detects the job's end."""
        changed = asyncio.Event()
        if row.id in self._rows:  # it may have changed since `row` was read
            changed.set()
        self._followers.setdefault(row.id, []).append(changed)
        if self._reader is None or self._reader.done():
            # in its own context, not that of the first request
            self._reader = asyncio.get_running_loop().create_task(self._read(closing), context=Context())
        try:
            yield row
            while not closing.is_set():
                await changed.wait()
                changed.clear()
                if (row_now := self._rows.get(row.id)) is not None:
                    yield row_now
        finally:
            self._followers[row.id].remove(changed)
            if not self._followers[row.id]:
                del self._followers[row.id]
                self._rows.pop(row.id, None)

    async def _read(self, closing: asyncio.Event) -> None:
        while self._followers and not closing.is_set():
            try:
                rows = await to_thread.run_sync(self._read_rows, list(self._followers))
            except Exception:  # a database error: the next read may succeed
                logger.exception("could not read the followed jobs")
                rows = []
            for row in rows:
                known = self._rows.get(row.id)
                if row.id in self._followers and (known is None or _mark(known) != _mark(row)):
                    self._rows[row.id] = row
                    self._wake(row.id)
            with suppress(TimeoutError):
                await asyncio.wait_for(closing.wait(), CHECK_S)
        for job in list(self._followers):
            self._wake(job)

    def _wake(self, job: str) -> None:
        for changed in self._followers[job]:
            changed.set()

    def _read_rows(self, jobs: list[str]) -> list[JobRow]:
        with self.database.session() as session:
            return list(session.scalars(select(JobRow).where(JobRow.id.in_(jobs))))


def _mark(row: JobRow) -> tuple[object, ...]:
    """Return the columns that identify a change."""
    return row.state, row.heartbeat_at, row.finished_at, row.progress, row.history
