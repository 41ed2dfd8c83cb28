"""Words and units in column names such as `tau_J1`, `jointPosition1` and `panda_joint1/position [deg]`."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

_POSITIONS = {
    **{"rad": 1.0, "mrad": 1e-3, "deg": math.tau / 360, "rev": math.tau, "turn": math.tau},
    **{"m": 1.0, "cm": 1e-2, "mm": 1e-3},
}
CURRENTS = {"a": 1.0, "ma": 1e-3}
UNIT_FACTORS: dict[str, dict[str, float]] = {
    "t": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "q": _POSITIONS,
    "dq": {f"{unit}s{end}": factor for unit, factor in _POSITIONS.items() for end in ("", "1")}
    | {"rpm": math.tau / 60, "revmin": math.tau / 60, "1min": math.tau / 60, "min1": math.tau / 60},
    "ddq": {f"{unit}s{end}": factor for unit, factor in _POSITIONS.items() for end in ("2", "s")}
    | {"rpms": math.tau / 60},
    "tau": {
        **{"nm": 1.0, "mnm": 1e-3, "nmm": 1e-3, "ncm": 1e-2, "knm": 1e3, "kgfcm": 0.0980665, "kgfm": 9.80665},
        **{"n": 1.0, "kn": 1e3},
        **CURRENTS,
    },
}
"""Factor to SI by quantity and unit, as `normalise_unit` writes it: rad/s and rad_s are rads."""
KNOWN_UNITS = {
    "t": "s, ms, us, ns or min",
    "q": "rad, mrad, deg, rev, m, cm or mm",
    "dq": "rad/s, deg/s, rev/s, rpm, m/s or mm/s",
    "ddq": "rad/s^2, deg/s^2, rev/s^2, rpm/s, m/s^2 or mm/s^2",
    "tau": "N*m, mN*m, N*cm, N*mm, kgf*cm, N, or A or mA of motor current",
}
"""Units by quantity, for error messages."""

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
QUANTITY_WORDS: dict[str, tuple[str, str]] = {
    **dict.fromkeys(("q", "qpos", "pos", "position", "positions"), ("q", "position")),
    **dict.fromkeys(("angle", "angles", "theta", "θ"), ("q", "angle")),
    **dict.fromkeys(
        ("dq", "qd", "qdot", "qvel", "vel", "vels", "velocity", "velocities", "speed", "speeds", "omega", "ω"),
        ("dq", "velocity"),
    ),
    **dict.fromkeys(
        ("ddq", "qdd", "qddot", "qacc", "acc", "accel", "acceleration", "accelerations"), ("ddq", "acceleration")
    ),
    **dict.fromkeys(("tau", "torque", "torques", "trq", "moment", "moments", "τ"), ("tau", "torque")),
    **dict.fromkeys(("effort", "efforts", "eff"), ("tau", "effort")),
    **dict.fromkeys(("current", "currents", "cur", "iq", "i"), ("tau", "current")),
}
"""Quantity and kind by word; an effort may be a torque or a current."""
PHRASES: dict[tuple[str, ...], tuple[str, str]] = {
    ("q", "dot"): ("dq", "velocity"),
    ("q", "dot", "dot"): ("ddq", "acceleration"),
    ("q", "ddot"): ("ddq", "acceleration"),
    ("dot", "q"): ("dq", "velocity"),
    ("dot", "dot", "q"): ("ddq", "acceleration"),
    ("ddot", "q"): ("ddq", "acceleration"),
    ("i", "q"): ("tau", "current"),
    ("observation", "state"): ("q", "position"),
}
MEASURED = frozenset(("actual", "act", "measured", "meas", "feedback", "fb", "present", "real", "sensor", "observed"))
COMMANDED = frozenset(("desired", "des", "commanded", "cmd", "cmds", "ref", "action")) | frozenset(
    word + plural for word in ("target", "command", "reference", "setpoint", "goal") for plural in ("", "s")
)
NEUTRAL = frozenset(("joint", "joints", "jnt", "j", "axis", "motor", "filtered", "raw", "state", "value", "link"))
OTHER_QUANTITIES = (
    frozenset(("tcp", "ee", "eef", "cartesian", "pose", "orientation", "quaternion", "wrench", "twist", "imu"))
    | {"gyro", "accelerometer", "gravity", "coriolis", "friction", "momentum", "ext", "external", "limit", "limits"}
    | {"residual", "error", "err", "std", "variance", "hat", "temperature", "temp", "voltage"}
)
"""Words of columns that are not the position, velocity, acceleration or whole torque of a joint."""
_VOCABULARY = frozenset(QUANTITY_WORDS) | MEASURED | COMMANDED | NEUTRAL | OTHER_QUANTITIES


@lru_cache(maxsize=1024)
def normalise_unit(unit: str) -> str:
    """Return a unit in one spelling: lower case, abbreviated, without blanks and operators."""
    text = unit.lower()[:40]
    for spelling, short in _SPELLINGS:
        text = spelling.sub(short, text)
    return text


def unit_factor(quantity: str, unit: str) -> float | None:
    """Return the factor to SI of a unit of t, q, dq, ddq or tau (to A for currents); None for other units."""
    return UNIT_FACTORS.get(quantity, {}).get(normalise_unit(unit))


def is_current(unit: str | None) -> bool:
    """Return whether this is a unit of electric current."""
    return unit is not None and normalise_unit(unit) in CURRENTS


def split_unit(name: str) -> Iterator[tuple[str, str]]:
    """Yield the ways to split a column's name into a name and a unit, the most likely first.

    Examples: `q1 [deg]`, `q1 (deg)`, `q1_deg`, `dq1_deg_per_s`. Text in brackets may not be a unit.
    """
    text = name.rstrip()
    opening = text.rfind({"]": "[", ")": "("}.get(text[-1:], "\n"))
    if opening > 0:
        before, unit = text[:opening], text[opening + 1 : -1].strip()
        # without a blank it may be a joint, as in `position[3]`
        if before[-1].isspace() or is_unit(unit):
            yield before.rstrip(), unit
        return
    for place in [each.start() for each in re.finditer(r"[_ ]", name)][-4:]:
        before, unit = name[:place], name[place + 1 :]
        # a single letter is a unit only if it is unambiguous: in q1_m, but not in q_m
        single = len(normalise_unit(unit)) == 1 and not re.search(r"(?i)(\d\]?|time|stamp|elapsed|\bt)$", before)
        if before and not unit.rpartition("_")[2].isdecimal() and not single and is_unit(unit):
            yield before, unit


def is_unit(text: str) -> bool:
    """Return whether a text is a unit of any quantity."""
    return any(normalise_unit(text) in units for units in UNIT_FACTORS.values())


@dataclass(frozen=True)
class Word:
    """A word in lower case or a number, with its place in a name."""

    text: str
    start: int
    end: int


@dataclass(frozen=True)
class QuantityMention:
    """A quantity in a name: the words first to last, last excluded."""

    quantity: str
    kind: str
    first: int
    last: int


def split_words(name: str) -> list[Word]:
    """Split a name into words and numbers."""
    cut_words = []
    for piece in re.finditer(r"[^\W\d_]+|\d+", name):
        text, start = piece.group(), piece.start()
        small = text.lower()
        if small in _VOCABULARY or small.isdecimal():
            cut_words.append(Word(small, start, piece.end()))
        elif (rest := small.removeprefix("joint")) != small and rest in QUANTITY_WORDS:
            cut = piece.end() - len(rest)
            cut_words += [Word("joint", start, cut), Word(rest, cut, piece.end())]
        else:
            camel = re.finditer(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", text)
            parts = [Word(m.group().lower(), start + m.start(), start + m.end()) for m in camel]
            known = text.isascii() and any(part.text in _VOCABULARY for part in parts)
            cut_words += parts if known else [Word(small, start, piece.end())]
    return cut_words


def find_quantity(parts: list[Word]) -> QuantityMention | None:
    """Return the last quantity among the words: `current_position` is a position."""
    last = None
    place = 0
    while place < len(parts):
        for length in (3, 2, 1):
            texts = tuple(word.text for word in parts[place : place + length])
            meaning = PHRASES.get(texts) if length > 1 else QUANTITY_WORDS.get(texts[0])
            if meaning is not None:
                last = QuantityMention(*meaning, place, place + length)
                place += length - 1
                break
        place += 1
    return last
