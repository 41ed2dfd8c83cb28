"""What happens to a job, kept in its row in words: every change of its state has an entry."""

from __future__ import annotations

from service.foundation.states import ACTIVE, QUEUED, JobState
from service.storage.database import JobRow, now

MOST_ENTRIES = 100
"""Entries that a job keeps: a service may be started and stopped any number of times while one waits."""


def enter(row: JobRow, state: JobState, message: str) -> None:
    """Set a job's state and note when and why. An end is stamped; who waits again has made no progress."""
    at = now()
    entries = [*(row.history or []), {"at": at, "state": state, "message": message}]
    # the first entry says who queued it; of the others the newest count
    row.history = entries if len(entries) <= MOST_ENTRIES else [entries[0], *entries[1 - MOST_ENTRIES :]]
    row.state = state
    if state == QUEUED:
        row.progress = {"stage": "waiting"}
        row.owner = None  # any service may have it run
    elif state not in ACTIVE:
        row.finished_at = at
