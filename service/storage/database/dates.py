"""Dates as the database stores them: ISO 8601 in UTC, with milliseconds."""

from __future__ import annotations

from datetime import UTC, datetime


def now() -> str:
    """Return the current time, ISO 8601 in UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


MOMENT_RANGE = (-62135596800.0, 253402300799.0)
"""First and last second that a date has, the years 1 to 9999, Unix time, s."""


def iso_time(seconds: float) -> str:
    """Return Unix seconds as an ISO time, the nearest that exists."""
    within = min(max(seconds, MOMENT_RANGE[0]), MOMENT_RANGE[1])
    return datetime.fromtimestamp(within, UTC).isoformat(timespec="milliseconds")
