"""How numbers are written in sentences and tables."""

from __future__ import annotations


def percent(share: float, digits: int = 0) -> str:
    """A share in per cent, as `95 %`."""
    return f"{share:.{digits}%}".replace("%", " %")


def counted(number: int, noun: str, nouns: str | None = None) -> str:
    """A number of things, as `1 episode` and `2 episodes`; nouns: of several, where that is not the noun and an s."""
    return f"{number:,} {noun if number == 1 else nouns or f'{noun}s'}"
