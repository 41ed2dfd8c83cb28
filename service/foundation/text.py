"""Numbers and times as text for sentences, tables and responses."""

from __future__ import annotations

from datetime import UTC, datetime

MOMENT_RANGE = (-62135596800.0, 253402300799.0)
"""First and last second that a date has, the years 1 to 9999, Unix time, s."""


def iso_time(seconds: float) -> str:
    """Format Unix seconds as an ISO time in milliseconds, the nearest that exists."""
    within = min(max(seconds, MOMENT_RANGE[0]), MOMENT_RANGE[1])
    return datetime.fromtimestamp(within, UTC).isoformat(timespec="milliseconds")


def percent(share: float, digits: int = 0) -> str:
    """Format a share in per cent, such as `95 %`."""
    return f"{share:.{digits}%}".replace("%", " %")


def counted(number: int, noun: str, nouns: str | None = None) -> str:
    """Format a number of things, such as `1 episode` or `2 episodes`.

    nouns: the plural, if it is not the noun and an s.
    """
    return f"{number:,} {noun if number == 1 else nouns or f'{noun}s'}"
