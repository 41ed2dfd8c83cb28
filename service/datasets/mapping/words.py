"""The words in columns' names, cut apart: `tau_J1`, `jointPosition1` and `panda_joint1/position` alike."""

from __future__ import annotations

import re
from dataclasses import dataclass

QUANTITY_WORDS: dict[str, tuple[str, str]] = {
    **dict.fromkeys(("q", "pos", "position", "positions"), ("q", "position")),
    **dict.fromkeys(("angle", "angles", "theta", "θ"), ("q", "angle")),
    **dict.fromkeys(
        ("dq", "qd", "qdot", "vel", "vels", "velocity", "velocities", "speed", "speeds", "omega", "ω"),
        ("dq", "velocity"),
    ),
    **dict.fromkeys(("ddq", "qdd", "qddot", "acc", "accel", "acceleration", "accelerations"), ("ddq", "acceleration")),
    **dict.fromkeys(("tau", "torque", "torques", "trq", "moment", "moments", "τ"), ("tau", "torque")),
    **dict.fromkeys(("effort", "efforts", "eff"), ("tau", "effort")),
    **dict.fromkeys(("current", "currents", "cur", "iq"), ("tau", "current")),
}
"""Quantity by word, and what kind of word it is: an effort may be a torque or a current."""
TWO_WORDS: dict[tuple[str, ...], tuple[str, str]] = {
    ("q", "dot"): ("dq", "velocity"),
    ("q", "dot", "dot"): ("ddq", "acceleration"),
    ("q", "ddot"): ("ddq", "acceleration"),
    ("i", "q"): ("tau", "current"),
    ("observation", "state"): ("q", "position"),
}
MEASURED = frozenset(("actual", "act", "measured", "meas", "feedback", "fb", "present", "real", "sensor", "observed"))
COMMANDED = frozenset(
    ("target", "desired", "des", "commanded", "command", "cmd", "reference", "ref", "setpoint", "goal", "action")
)
DESIRED = "d"
"""As in Franka's `q_d` and `tau_J_d`: only behind the quantity, as `d` alone may be anything else."""
NEUTRAL = frozenset(("joint", "joints", "jnt", "j", "axis", "motor", "filtered", "raw", "state", "value", "link"))
FOREIGN = (
    frozenset(
        ("tcp", "ee", "eef", "cartesian", "pose", "wrench", "twist", "imu", "error", "err", "ext", "external", "limit")
    )
    | frozenset(
        (
            "limits",
            "temperature",
            "temp",
            "voltage",
            "std",
            "variance",
            "hat",
            "gravity",
            "coriolis",
            "friction",
            "gyro",
        )
    )
    | frozenset(("accelerometer", "momentum", "residual", "orientation", "quaternion"))
)
"""A column with such a word is no position, velocity, acceleration or whole torque of a joint."""
_VOCABULARY = frozenset(QUANTITY_WORDS) | MEASURED | COMMANDED | NEUTRAL | FOREIGN
_PIECES = re.compile(r"[^\W\d_]+|\d+")
_CAMEL = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
_JOINT = "joint"


@dataclass(frozen=True)
class Word:
    """A word or number of a name: small letters, and where it is."""

    text: str
    start: int
    end: int


@dataclass(frozen=True)
class Mention:
    """Where a name speaks of a quantity: words first to last, the latter not included."""

    quantity: str
    kind: str
    first: int
    last: int


def words(name: str) -> list[Word]:
    """Cut a name into words and numbers."""
    found = []
    for piece in _PIECES.finditer(name):
        text, start = piece.group(), piece.start()
        small = text.lower()
        if small in _VOCABULARY or small.isdecimal():
            found.append(Word(small, start, piece.end()))
        elif small.startswith(_JOINT) and small[len(_JOINT) :] in QUANTITY_WORDS:
            cut = start + len(_JOINT)
            found += [Word(_JOINT, start, cut), Word(small[len(_JOINT) :], cut, piece.end())]
        else:
            parts = [Word(m.group().lower(), start + m.start(), start + m.end()) for m in _CAMEL.finditer(text)]
            known = text.isascii() and any(part.text in _VOCABULARY for part in parts)
            found += parts if known else [Word(small, start, piece.end())]
    return found


def mention(found: list[Word]) -> Mention | None:
    """The quantity that words speak of: the last one, as `current_position` is a position."""
    last = None
    place = 0
    while place < len(found):
        for length in (3, 2, 1):
            texts = tuple(word.text for word in found[place : place + length])
            said = TWO_WORDS.get(texts) if length > 1 else QUANTITY_WORDS.get(texts[0])
            if said is not None:
                last = Mention(*said, place, place + length)
                place += length - 1
                break
        place += 1
    return last
