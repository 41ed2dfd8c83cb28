"""Finding the quantity and joint of a column from its name."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

from service.datasets.mapping.vocabulary import (
    COMMANDED,
    MEASURED,
    NEUTRAL,
    OTHER_QUANTITIES,
    QuantityMention,
    Word,
    find_quantity,
    split_unit,
    split_words,
    unit_factor,
)

JOINT = "{joint}"
"""Placeholder for a joint's name or number in a pattern."""
JointKey = int | str
"""Key of a joint in a file: its number, from 1, or its name in lower case."""
_NUMBERED = re.compile(r"(?:joint|jnt|axis|motor|[aj])?[\s_.\-\[(]*0*(\d{1,6})[\])]*")
_PATHS = re.compile(r"[/.:]")
_ADJECTIVES = MEASURED | COMMANDED | {"current"}
MAX_NAME_CHARS = 150
"""Longer column names are ignored."""


class Rank(IntEnum):
    """Preference of a family by its column names, the best first."""

    CANONICAL = 0
    """The documented names, q1…."""
    MEASURED = 1
    PLAIN = 2
    """Names without a word for measured or commanded."""
    COMMANDED = 3


@dataclass(frozen=True)
class NameReading:
    """One interpretation of a column's name. joint: "" if it has none; kind: kind of word, see QUANTITY_WORDS."""

    quantity: str
    kind: str
    pattern: str
    joint: str
    rank: Rank
    unit: str | None


@dataclass(frozen=True)
class Member:
    """A joint's column in a family: its index, the joint's name in the file, and the unit in the column's name."""

    index: int
    label: str
    unit: str | None = None


@dataclass
class Family:
    """Columns of one quantity with the same name pattern, by joint in the file's order."""

    quantity: str
    kind: str
    pattern: str
    rank: Rank
    members: dict[JointKey, Member] = field(default_factory=dict)
    repeated: list[int] = field(default_factory=list)
    """Indices of further columns of joints that already have one."""
    listed: bool = False
    """Whether the user listed the columns."""

    @property
    def numbered(self) -> bool:
        """Whether all joints have numbers."""
        return all(isinstance(key, int) for key in self.members)


def find_families(names: Sequence[str]) -> list[Family]:
    """Sort columns into families; a name with several interpretations belongs to the largest family."""
    readings = [interpret_name(name) for name in names]
    sizes: dict[tuple[str, ...], int] = defaultdict(int)
    for each in readings:
        for reading in each:
            sizes[_family_key(reading)] += 1
    chosen: dict[tuple[str, ...], list[tuple[int, NameReading]]] = defaultdict(list)
    for index, each in enumerate(readings):
        if each:
            best = max(each, key=lambda reading: sizes[_family_key(reading)])
            chosen[_family_key(best)].append((index, best))
    return [_family(group) for group in chosen.values()]


def keys_of_joints(labels: Sequence[str]) -> list[JointKey]:
    """Return the keys of joints with these labels; numbers from 0 are shifted to 1, an empty label is joint 1."""
    numbers = [_NUMBERED.fullmatch(label.strip().lower()) for label in labels]
    shift = int(any(match is not None and int(match[1]) == 0 for match in numbers))
    return [
        int(match[1]) + shift if match else label.strip().lower() or 1
        for label, match in zip(labels, numbers, strict=True)
    ]


def interpret_name(name: str) -> list[NameReading]:
    """Return the interpretations of a column's name, the most likely first; empty if it names no quantity."""
    if len(name) > MAX_NAME_CHARS:
        return []
    for before, unit in split_unit(name):
        parsed = _parse(before, unit, name[len(before) :])
        if parsed and (
            unit_factor(parsed[0].quantity, unit) is not None or name[len(before) :].lstrip()[:1] in ("[", "(")
        ):
            return parsed
    return _parse(name, None, "")


def expand_pattern(pattern: str, names: Sequence[str], quantity: str) -> Family:
    """Return the columns that match a user's pattern."""
    before, _, after = pattern.partition(JOINT)
    matches = [
        (index, name[len(before) : len(name) - len(after)])
        for index, name in enumerate(names)
        if name.startswith(before) and name.endswith(after) and len(name) > len(before) + len(after)
    ]
    if JOINT not in pattern:
        matches = [(index, "") for index, name in enumerate(names) if name == pattern]
    first = next((s for index, _ in matches for s in interpret_name(names[index]) if s.quantity == quantity), None)
    kind = quantity if first is None else first.kind
    rank = Rank.COMMANDED if first is not None and first.rank == Rank.COMMANDED else Rank.PLAIN
    units = [_unit_of(names[index]) for index, _ in matches]
    readings = [
        NameReading(quantity, kind, pattern, label, rank, unit) for (_, label), unit in zip(matches, units, strict=True)
    ]
    if not readings:
        return Family(quantity, kind, pattern, Rank.PLAIN)
    return _family([(index, each) for (index, _), each in zip(matches, readings, strict=True)])


def _unit_of(name: str) -> str | None:
    return next((reading.unit for reading in interpret_name(name)), None)


def _family_key(reading: NameReading) -> tuple[str, ...]:
    return reading.quantity, reading.pattern.lower()


def _family(group: list[tuple[int, NameReading]]) -> Family:
    first = group[0][1]
    out = Family(first.quantity, first.kind, first.pattern, first.rank)
    for (index, reading), key in zip(group, keys_of_joints([each.joint for _, each in group]), strict=True):
        if key in out.members:
            out.repeated.append(index)
        else:
            out.members[key] = Member(index, reading.joint, reading.unit)
    return out


def _parse(name: str, unit: str | None, ending: str) -> list[NameReading]:
    parts = split_words(name)
    subject = find_quantity(parts)
    if subject is None or any(word.text in OTHER_QUANTITIES for word in parts):
        return []
    behind = parts[subject.last :]
    inner = _inner_unit(subject, behind) if unit is None else ()
    unit = " ".join(inner) or unit
    # Franka marks desired values with `d` after the quantity: q_d, tau_J_d; elsewhere `d` may be anything
    commanded = any(word.text in COMMANDED for word in parts) or any(word.text == "d" for word in behind[:2])
    measured = any(word.text in MEASURED for word in parts)
    out = []
    for start, end in _joints(name, parts, subject, inner):
        pattern = (name[:start] + JOINT + name[end:] if end > start else name) + ending
        canonical = re.fullmatch(r"d?d?q\{joint\}|tau\{joint\}", pattern.removesuffix(ending).rstrip()) is not None
        rank = (
            Rank.COMMANDED if commanded else Rank.CANONICAL if canonical else Rank.MEASURED if measured else Rank.PLAIN
        )
        out.append(NameReading(subject.quantity, subject.kind, pattern, name[start:end], rank, unit))
    return out


def _inner_unit(subject: QuantityMention, behind: list[Word]) -> tuple[str, ...]:
    """Return the unit between a quantity and a joint's number, as in `pos_deg_1` and `vel_rad_s_1`."""
    texts = [word.text for word in behind]
    for end in range(len(texts) - 1, 0, -1):
        unit = " ".join(texts[:end])
        if len(unit) > 1 and unit_factor(subject.quantity, unit) is not None:
            return tuple(texts[:end])
    return ()


def _joints(name: str, parts: list[Word], subject: QuantityMention, unit: tuple[str, ...]) -> list[tuple[int, int]]:
    """Return where a joint may be named in `name`, (start, end), the most likely first."""
    besides = MEASURED | COMMANDED | NEUTRAL | {"d", *unit}
    behind = [word for word in parts[subject.last :] if word.text not in besides]
    if len(behind) == 1 and behind[0].text.isdecimal():
        return [(behind[0].start, behind[0].end)]
    out = []
    ahead = parts[: subject.first]
    while ahead and ahead[-1].text in _ADJECTIVES:
        ahead = ahead[:-1]
    while ahead and ahead[0].text in _ADJECTIVES:
        ahead = ahead[1:]
    if ahead and not all(word.text in ("joint", "joints", "state") for word in ahead):
        out.append(_last_part(name, ahead))
    if behind:
        place = (behind[0].start, _end_with_bracket(name, behind[0].start, behind[-1].end))
        # in `joint1_torque_sensor2` the first number is the joint's
        out.insert(len(out) if any(word.text.isdecimal() for word in ahead) else 0, place)
    return out or [(0, 0)]


def _last_part(name: str, ahead: list[Word]) -> tuple[int, int]:
    """Return the last part of a path: the joint in `joint_states/panda_joint1`."""
    start, end = ahead[0].start, _end_with_bracket(name, ahead[0].start, ahead[-1].end)
    cuts = [match.end() for match in _PATHS.finditer(name, start, ahead[-1].start)]
    inner = max(cuts, default=start)
    return (inner, end) if name[inner:end].strip("_ -") else (start, end)


def _end_with_bracket(name: str, start: int, end: int) -> int:
    """Return the end of a joint's name, including a closing bracket as in `joint[1]`."""
    return end + 1 if name[end : end + 1] == "]" and "[" in name[start:end] else end


_TIMES = re.compile(
    r"(?:_*|%|elapsed[_ ]?|log[_ ]?|ros[_ ]?|robot[_ ]?)(?:t|time|times|timestamp|timestamps|stamp)|(?:\w+_)?ts"
)
_SPLIT_STAMP = re.compile(r"(.*?)(nsecs?|nanosecs?|nanoseconds|nanos|secs?|seconds)")


def is_episode(name: str) -> bool:
    """Return whether a column holds the numbers of contiguous recordings."""
    return re.fullmatch(r"(episode|trajectory|run)(_index|_id)?", name.strip().lower()) is not None


@dataclass(frozen=True)
class TimeColumn:
    """A time in a file, in one column or in two."""

    name: str
    rank: int
    """0 for `t`, 1 for stamps of messages, 2 for others."""
    parts: tuple[tuple[int, str | None], ...]
    """(index, unit) of the column, or of the columns of whole seconds and nanoseconds."""


def find_times(names: Sequence[str]) -> list[TimeColumn]:
    """Return the times among the columns, best first: `t`, then stamps of messages, then others."""
    out, split = _find_split_stamps(names)
    for index, name in enumerate(names):
        if name == "t":
            out.append(TimeColumn(name, 0, ((index, None),)))
        elif index not in split and len(name) <= MAX_NAME_CHARS:
            for before, unit in [*split_unit(name), (name, None)]:
                last = _PATHS.split(before.strip().lower())[-1].strip()
                if _TIMES.fullmatch(last) and (unit is None or unit_factor("t", unit) is not None):
                    # `rostopic echo -p` writes nanoseconds
                    stamp_unit = "ns" if unit is None and (name == "%time" or name.startswith("field.header")) else unit
                    out.append(TimeColumn(name, 1 if last == "stamp" else 2, ((index, stamp_unit),)))
                    break
    return sorted(out, key=lambda clock: clock.rank)


def _find_split_stamps(names: Sequence[str]) -> tuple[list[TimeColumn], set[int]]:
    """Return stamps in two columns, whole seconds and nanoseconds as in ROS, and the indices of these columns."""
    halves: dict[str, dict[str, int]] = defaultdict(dict)
    for index, name in enumerate(names):
        if len(name) <= MAX_NAME_CHARS and (match := _SPLIT_STAMP.fullmatch(name.strip().lower())):
            last = [part for part in re.split(r"[/.:_ ]", match[1]) if part][-1:]
            if not last or last[0] in ("stamp", "time", "timestamp", "header"):
                halves[match[1]]["ns" if match[2].startswith("n") else "s"] = index
    out = []
    for before, half in halves.items():
        if len(half) == 2 or (half.keys() == {"s"} and not before):
            parts = tuple((half[unit], unit) for unit in ("s", "ns") if unit in half)
            out.append(TimeColumn(names[half["s"]], 1 if "stamp" in before else 2, parts))
    return out, {index for clock in out for index, _ in clock.parts}


def columns_hint(columns: Mapping[str, str]) -> str:
    """Return the option `columns` for these column names."""
    return f"columns={json.dumps(dict(columns), ensure_ascii=False)}"
