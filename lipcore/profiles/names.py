"""Names in a recording matched with the joints of a robot, despite prefixes, spellings and numbers.

Drivers prefix names (`left_panda_joint1`, `ur5e_elbow_joint`), rename them (`fer_joint1`), or number them (`joint1`,
`J0`). Names are compared as words: lower case, split at punctuation, capitals and digits, without the word "joint".
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from functools import lru_cache

Words = tuple[str, ...]
Assignment = dict[int, int]
"""Joint of the robot → index among the names."""

_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+|\d+")
_CHUNK = re.compile(r"[^a-z0-9]+")
_EMPTY = frozenset({"joint", "joints", "jnt", "j"})
"""Words that do not identify a joint."""

MAKES = frozenset(
    {"panda", "fer", "fr3"}
    | {"ur3", "ur5", "ur10", "ur3e", "ur5e", "ur10e", "ur16e"}
    | {"xarm", "xarm5", "xarm6", "xarm7", "lite6"}
    | {"kinova", "jaco", "j2s6s200", "j2s6s300", "gen3"}
    | {"kuka", "lbr", "iiwa", "iiwa7", "iiwa14"}
    | {"z1", "so100", "so101", "baxter", "talos", "tiago", "pr2"}
)
"""Words by which a prefix names a make: `panda_joint1` is no joint of an xArm, though its first is `joint1`."""


def find_makes(text: str) -> frozenset[str]:
    """Return the words of MAKES in a name or a title."""
    return frozenset(_CHUNK.split(text.lower())) & MAKES


def split_words(name: str) -> Words:
    """Return the words of a name that identify a joint."""
    return tuple(word for word in (each.lower() for each in _WORD.findall(name)) if word not in _EMPTY)


def is_number(name: str) -> bool:
    """Return whether a name is only a number: every robot has a joint 1."""
    return "".join(split_words(name)).isdigit()


def find_assignments(
    names: Sequence[str], aliases: Sequence[Sequence[str]], own: frozenset[str], numbers: bool = True
) -> Iterator[Assignment]:
    """Yield each assignment of the names to joints of one robot; two arms side by side yield two. It may be incomplete.

    aliases: (n) names of each joint; own: the makes that a prefix of plain numbers may name; numbers: whether a number
    alone may name a joint.
    """
    place_of = {name: place for place, name in enumerate(names)}
    exact = {joint: place_of[each[0]] for joint, each in enumerate(aliases) if each[0] in place_of}
    if len(exact) == len(aliases) and len(place_of) == len(names):
        yield exact
        return
    if len(names) > 1000:  # no robot has that many joints
        return
    split = [split_words(name) for name in names]
    by_words = _by_words(split, aliases)
    if by_words:
        yield from by_words
    elif numbers and all(find_makes(name) <= own for name in names):
        yield from _by_number(split, len(aliases))


@lru_cache(maxsize=64)
def _forms(aliases: tuple[tuple[str, ...], ...]) -> list[frozenset[Words]]:
    return [
        frozenset(form for form in map(split_words, each) if form and not "".join(form).isdigit()) for each in aliases
    ]


def _by_words(split: Sequence[Words], aliases: Sequence[Sequence[str]]) -> list[Assignment]:
    """Return the assignments of names that end in an alias, grouped by prefix; numeric aliases are ignored."""
    forms = _forms(tuple(map(tuple, aliases)))
    places_by_prefix: defaultdict[Words, defaultdict[int, set[int]]] = defaultdict(lambda: defaultdict(set))
    for place, name in enumerate(split):
        for joint, each in enumerate(forms):
            for form in each:
                if name[-len(form) :] == form:
                    places_by_prefix[name[: -len(form)]][joint].add(place)
    groups = (
        {joint: min(places) for joint, places in group.items() if len(places) == 1}
        for group in places_by_prefix.values()
    )
    return _distinct(group for group in groups if group)


def _by_number(split: Sequence[Words], n_joints: int) -> list[Assignment]:
    """Return the assignments of names that are numbers behind one prefix, counted from 1, or from 0 if there is a 0."""
    numbers_by_prefix: defaultdict[Words, list[tuple[int, int]]] = defaultdict(list)
    for place, name in enumerate(split):
        if name and name[-1].isdigit() and len(name[-1]) < 4:
            numbers_by_prefix[name[:-1]].append((int(name[-1]), place))
    groups = []
    for group in numbers_by_prefix.values():
        first = 0 if any(number == 0 for number, _ in group) else 1
        numbered = {number - first: place for number, place in group}
        # a number too many or twice, or other names in the majority, mean another robot
        if len(numbered) == len(group) and max(numbered) < n_joints and 2 * len(group) > len(split):
            groups.append(numbered)
    return _distinct(groups)


def _distinct(groups: Iterator[Assignment] | Sequence[Assignment]) -> list[Assignment]:
    """Return the groups that no other group contains."""
    distinct: list[Assignment] = []
    holders: defaultdict[tuple[int, int], list[Assignment]] = defaultdict(list)
    for group in sorted(groups, key=len, reverse=True):
        if not any(group.items() <= larger.items() for larger in holders[next(iter(group.items()))]):
            distinct.append(group)
            for item in group.items():
                holders[item].append(group)
    return distinct
