"""Units that columns may be in, as headers, files and users write them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from functools import lru_cache

TURN = 2 * math.pi
_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": TURN / 360, "rev": TURN, "turn": TURN}
_POSITIONS = _ANGLES | _LENGTHS
CURRENTS = {"a": 1.0, "ma": 1e-3}
_TORQUES = {
    **{"nm": 1.0, "mnm": 1e-3, "nmm": 1e-3, "ncm": 1e-2, "knm": 1e3, "kgfcm": 0.0980665, "kgfm": 9.80665},
    **{"n": 1.0, "kn": 1e3},
}
FACTORS: dict[str, dict[str, float]] = {
    "t": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "q": _POSITIONS,
    "dq": {f"{unit}s{end}": factor for unit, factor in _POSITIONS.items() for end in ("", "1")}
    | {"rpm": TURN / 60, "revmin": TURN / 60, "1min": TURN / 60, "min1": TURN / 60},
    "ddq": {f"{unit}s{end}": factor for unit, factor in _POSITIONS.items() for end in ("2", "s")} | {"rpms": TURN / 60},
    "tau": _TORQUES | CURRENTS,
}
"""SI units in one of each unit by quantity, units as `plain` writes them: rad/s and rad_s are rads."""
KNOWN = {
    "t": "s, ms, us, ns or min",
    "q": "rad, mrad, deg, rev, m, cm or mm",
    "dq": "rad/s, deg/s, rev/s, rpm, m/s or mm/s",
    "ddq": "rad/s^2, deg/s^2, rev/s^2, rpm/s, m/s^2 or mm/s^2",
    "tau": "N*m, mN*m, N*cm, N*mm, kgf*cm, N, or A or mA of motor current",
}
"""What to tell users of the units of a quantity."""

_SPELLINGS = (
    (re.compile(r"[µμ]"), "u"),
    (re.compile(r"²"), "2"),
    (re.compile(r"°|degrees?"), "deg"),
    (re.compile(r"radians?"), "rad"),
    (re.compile(r"revolutions?|revs"), "rev"),
    (re.compile(r"turns"), "turn"),
    (re.compile(r"millisec(onds?)?|msec"), "ms"),
    (re.compile(r"microsec(onds?)?|usec"), "us"),
    (re.compile(r"nanosec(onds?)?|nsec"), "ns"),
    (re.compile(r"sec(onds?|s)?"), "s"),
    (re.compile(r"minutes?"), "min"),
    (re.compile(r"met(er|re)s?"), "m"),
    (re.compile(r"newtons?"), "n"),
    (re.compile(r"milliamp(ere)?s?"), "ma"),
    (re.compile(r"amp(ere)?s?"), "a"),
    (re.compile(r"per"), ""),
    (re.compile(r"[\s_/*·⋅.^−-]"), ""),
)
_OPENING = {"]": "[", ")": "("}
_NUMBERED = re.compile(r"(\d\]?|time|stamp|elapsed|\bt)$", re.IGNORECASE)
_LONGEST = 40
_SUFFIX_WORDS = 4


@lru_cache(maxsize=1024)
def plain(unit: str) -> str:
    """A unit without what spellings differ in: case, blanks, signs of multiplication and division, full words."""
    found = unit.lower()[:_LONGEST]
    for spelling, short in _SPELLINGS:
        found = spelling.sub(short, found)
    return found


def factor(quantity: str, unit: str) -> float | None:
    """SI units in one `unit` of t, q, dq, ddq or tau (A for currents); None where it is no unit of that."""
    return FACTORS.get(quantity, {}).get(plain(unit))


def is_current(unit: str | None) -> bool:
    """Whether this is a unit of electric current."""
    return unit is not None and plain(unit) in CURRENTS


def in_header(name: str) -> Iterator[tuple[str, str]]:
    """The ways in which a column's name may end in a unit: what is before it, and the unit. Likeliest first.

    `q1 [deg]`, `q1 (deg)`, `q1_deg`, `dq1_deg_per_s`. What is in brackets may be no unit at all.
    """
    text = name.rstrip()
    opening = text.rfind(_OPENING.get(text[-1:], "\n"))
    if opening > 0:
        before, unit = text[:opening], text[opening + 1 : -1].strip()
        # without a blank it may be a joint's number or name, as in `position[3]`
        if before[-1].isspace() or _is_unit(unit):
            yield before.rstrip(), unit
        return
    words = [each.start() for each in re.finditer(r"[_ ]", name)][-_SUFFIX_WORDS:]
    for place in words:
        before, unit = name[:place], name[place + 1 :]
        # one letter is a unit only where nothing else can be meant: of q1_m, but not of q_m
        single = len(plain(unit)) == 1 and not _NUMBERED.search(before)
        if before and not unit.rpartition("_")[2].isdecimal() and not single and _is_unit(unit):
            yield before, unit


def _is_unit(text: str) -> bool:
    return any(plain(text) in units for units in FACTORS.values())
