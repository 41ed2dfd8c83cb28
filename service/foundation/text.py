"""Numbers as text for sentences and tables."""

from __future__ import annotations


def percent(share: float, digits: int = 0) -> str:
    """Format a share in per cent, such as `95 %`."""
    return f"{share:.{digits}%}".replace("%", " %")


def counted(number: int, noun: str, nouns: str | None = None) -> str:
    """Format a number of things, such as `1 episode` or `2 episodes`.

    nouns: the plural, if it is not the noun and an s.
    """
    return f"{number:,} {noun if number == 1 else nouns or f'{noun}s'}"
