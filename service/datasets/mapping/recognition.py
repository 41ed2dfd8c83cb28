"""Which column is which quantity of which joint, as far as its name tells."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

from service.datasets.mapping.vocabulary import (
    COMMANDED,
    FOREIGN,
    MEASURED,
    NEUTRAL,
    Mention,
    Word,
    factor,
    in_header,
    mention,
    words,
)

JOINT = "{joint}"
"""In a pattern: where the joint's name or number is."""
Key = int | str
"""What tells a joint within a file: its number, from 1 on, or its name in small letters."""
_NUMBERED = re.compile(r"(?:joint|jnt|axis|motor|[aj])?[\s_.\-\[(]*0*(\d{1,6})[\])]*")
_PATHS = re.compile(r"[/.:]")
_ADJECTIVES = MEASURED | COMMANDED | {"current"}
MAX_NAME = 150
"""Longer names are not looked at."""


class Rank(IntEnum):
    """How a family's columns are named, the best first: as documented, measured, neither, commanded."""

    CANONICAL = 0
    MEASURED = 1
    PLAIN = 2
    AIM = 3


@dataclass(frozen=True)
class Sighting:
    """What a column's name says. joint: "" where no joint is named; kind: of word, see QUANTITY_WORDS."""

    quantity: str
    kind: str
    pattern: str
    joint: str
    rank: Rank
    unit: str | None


@dataclass(frozen=True)
class Member:
    """A joint's column of a family: its index, what the file calls the joint, the unit in its name."""

    index: int
    label: str
    unit: str | None = None


@dataclass
class Family:
    """Columns of one quantity that are named alike, by joint in the file's order; listed: one by one, by the user."""

    quantity: str
    kind: str
    pattern: str
    rank: Rank
    members: dict[Key, Member] = field(default_factory=dict)
    doubled: list[int] = field(default_factory=list)
    listed: bool = False

    @property
    def numbered(self) -> bool:
        """Whether all its joints have numbers."""
        return all(isinstance(key, int) for key in self.members)


def families(names: Sequence[str]) -> list[Family]:
    """Sort columns into families; a name that can be read in two ways belongs to the larger family."""
    seen = [sightings(name) for name in names]
    sizes: dict[tuple[str, ...], int] = defaultdict(int)
    for each in seen:
        for sighting in each:
            sizes[_alike(sighting)] += 1
    chosen: dict[tuple[str, ...], list[tuple[int, Sighting]]] = defaultdict(list)
    for index, each in enumerate(seen):
        if each:
            best = max(each, key=lambda sighting: sizes[_alike(sighting)])
            chosen[_alike(best)].append((index, best))
    return [_family(group) for group in chosen.values()]


def keys(labels: Sequence[str]) -> list[Key]:
    """Keys of joints that a file calls so; numbers that start at 0 are counted from 1, what has no name is joint 1."""
    numbers = [_NUMBERED.fullmatch(label.strip().lower()) for label in labels]
    shift = int(any(match is not None and int(match[1]) == 0 for match in numbers))
    return [
        int(match[1]) + shift if match else label.strip().lower() or 1
        for label, match in zip(labels, numbers, strict=True)
    ]


def sightings(name: str) -> list[Sighting]:
    """The ways in which a column's name can be read, the likeliest first; none where it says nothing of a joint."""
    if len(name) > MAX_NAME:
        return []
    for before, unit in in_header(name):
        parsed = _parse(before, unit, name[len(before) :])
        if parsed and (factor(parsed[0].quantity, unit) is not None or name[len(before) :].lstrip()[:1] in ("[", "(")):
            return parsed
    return _parse(name, None, "")


def unfold(pattern: str, names: Sequence[str], quantity: str) -> Family:
    """The columns that a user's pattern stands for."""
    before, _, after = pattern.partition(JOINT)
    matches = [
        (index, name[len(before) : len(name) - len(after)])
        for index, name in enumerate(names)
        if name.startswith(before) and name.endswith(after) and len(name) > len(before) + len(after)
    ]
    if JOINT not in pattern:
        matches = [(index, "") for index, name in enumerate(names) if name == pattern]
    seen = next((s for index, _ in matches for s in sightings(names[index]) if s.quantity == quantity), None)
    kind = quantity if seen is None else seen.kind
    rank = Rank.AIM if seen is not None and seen.rank == Rank.AIM else Rank.PLAIN
    units = [_unit_of(names[index]) for index, _ in matches]
    alike = [
        Sighting(quantity, kind, pattern, label, rank, unit) for (_, label), unit in zip(matches, units, strict=True)
    ]
    if not alike:
        return Family(quantity, kind, pattern, Rank.PLAIN)
    return _family([(index, each) for (index, _), each in zip(matches, alike, strict=True)])


def _unit_of(name: str) -> str | None:
    return next((sighting.unit for sighting in sightings(name)), None)


def _alike(sighting: Sighting) -> tuple[str, ...]:
    return sighting.quantity, sighting.pattern.lower()


def _family(group: list[tuple[int, Sighting]]) -> Family:
    first = group[0][1]
    out = Family(first.quantity, first.kind, first.pattern, first.rank)
    for (index, sighting), key in zip(group, keys([each.joint for _, each in group]), strict=True):
        if key in out.members:
            out.doubled.append(index)
        else:
            out.members[key] = Member(index, sighting.joint, sighting.unit)
    return out


def _parse(name: str, unit: str | None, ending: str) -> list[Sighting]:
    parts = words(name)
    subject = mention(parts)
    if subject is None or any(word.text in FOREIGN for word in parts):
        return []
    behind = parts[subject.last :]
    inner = _inner_unit(subject, behind) if unit is None else ()
    unit = " ".join(inner) or unit
    # Franka marks a desired value behind its quantity: q_d, tau_J_d; elsewhere `d` may be anything
    aimed = any(word.text in COMMANDED for word in parts) or any(word.text == "d" for word in behind[:2])
    measured = any(word.text in MEASURED for word in parts)
    out = []
    for start, end in _joints(name, parts, subject, inner):
        pattern = (name[:start] + JOINT + name[end:] if end > start else name) + ending
        canonical = re.fullmatch(r"d?d?q\{joint\}|tau\{joint\}", pattern.removesuffix(ending).rstrip()) is not None
        rank = Rank.AIM if aimed else Rank.CANONICAL if canonical else Rank.MEASURED if measured else Rank.PLAIN
        out.append(Sighting(subject.quantity, subject.kind, pattern, name[start:end], rank, unit))
    return out


def _inner_unit(subject: Mention, behind: list[Word]) -> tuple[str, ...]:
    """Words between a quantity and a joint's number that are a unit: of `pos_deg_1`, `vel_rad_s_1`."""
    texts = [word.text for word in behind]
    for end in range(len(texts) - 1, 0, -1):
        unit = " ".join(texts[:end])
        if len(unit) > 1 and factor(subject.quantity, unit) is not None:
            return tuple(texts[:end])
    return ()


def _joints(name: str, parts: list[Word], subject: Mention, unit: tuple[str, ...]) -> list[tuple[int, int]]:
    """Where a joint may be named: first the likeliest."""
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
        place = (behind[0].start, _closed(name, behind[0].start, behind[-1].end))
        # `joint1_torque_sensor2`: the number ahead is the joint's
        out.insert(len(out) if any(word.text.isdecimal() for word in ahead) else 0, place)
    return out or [(0, 0)]


def _last_part(name: str, ahead: list[Word]) -> tuple[int, int]:
    """Of `joint_states/panda_joint1` the joint is what comes last."""
    start, end = ahead[0].start, _closed(name, ahead[0].start, ahead[-1].end)
    cuts = [match.end() for match in _PATHS.finditer(name, start, ahead[-1].start)]
    inner = max(cuts, default=start)
    return (inner, end) if name[inner:end].strip("_ -") else (start, end)


def _closed(name: str, start: int, end: int) -> int:
    """The end of a joint's name, with the bracket that it closes with: `joint[1]`."""
    return end + 1 if name[end : end + 1] == "]" and "[" in name[start:end] else end


_TIMES = re.compile(r"(?:_*|%|elapsed[_ ]?|log[_ ]?|ros[_ ]?|robot[_ ]?)(?:t|time|times|timestamp|timestamps|stamp)")
_HALVES = re.compile(r"(.*?)(nsecs?|nanosecs?|nanoseconds|secs?|seconds)")


def is_episode(name: str) -> bool:
    """Whether a column numbers contiguous recordings."""
    return re.fullmatch(r"(episode|trajectory|run)(_index|_id)?", name.strip().lower()) is not None


@dataclass(frozen=True)
class TimeColumn:
    """A time that a file holds: (index, unit) of the column, or of its whole seconds and the rest; rank: 0 is `t`."""

    name: str
    rank: int
    parts: tuple[tuple[int, str | None], ...]


def clocks(names: Sequence[str]) -> list[TimeColumn]:
    """Times among the columns, best first: `t`, then stamps of messages, then all others."""
    out, halved = _halved(names)
    for index, name in enumerate(names):
        if name == "t":
            out.append(TimeColumn(name, 0, ((index, None),)))
        elif index not in halved and len(name) <= MAX_NAME:
            for before, unit in [*in_header(name), (name, None)]:
                last = _PATHS.split(before.strip().lower())[-1].strip()
                if _TIMES.fullmatch(last) and (unit is None or factor("t", unit) is not None):
                    # rostopic writes nanoseconds
                    stamp_unit = "ns" if unit is None and (name == "%time" or name.startswith("field.header")) else unit
                    out.append(TimeColumn(name, 1 if last == "stamp" else 2, ((index, stamp_unit),)))
                    break
    return sorted(out, key=lambda clock: clock.rank)


def _halved(names: Sequence[str]) -> tuple[list[TimeColumn], set[int]]:
    """Stamps in two columns, whole seconds and nanoseconds, as ROS has them; and the indices of these columns."""
    halves: dict[str, dict[str, int]] = defaultdict(dict)
    for index, name in enumerate(names):
        if len(name) <= MAX_NAME and (match := _HALVES.fullmatch(name.strip().lower())):
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
    """How to say what columns are called: the option `columns`."""
    return f"columns={json.dumps(dict(columns), ensure_ascii=False)}"
