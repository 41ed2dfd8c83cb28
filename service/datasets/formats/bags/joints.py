"""Which joints of a channel are read, as its messages may tell of different ones, and in which order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from service.datasets.formats.bags.states import Kind
from service.foundation.errors import invalid_data, readable

MOST_KINDS = 1000
"""Sets of joints that the messages of a channel may tell of."""


def choose(kinds: Sequence[Kind], counts: Sequence[int], wanted: tuple[str, ...] | None, topic: str) -> tuple[str, ...]:
    """Joints to read: those `wanted`, or of the set that matters most; raise InvalidDataError.

    kinds and counts: what the messages hold, and how many hold it. A set matters by the messages that tell of all its
    joints, times the square of their number: an arm at 30 Hz more than its gripper at 200 Hz.
    """
    numbers: dict[frozenset[str], int] = {}
    orders: dict[frozenset[str], tuple[str, ...]] = {}
    for kind, count in sorted(zip(kinds, counts, strict=True), key=lambda each: -each[1]):
        if "position" in kind.quantities:
            numbers[frozenset(kind.joints)] = numbers.get(frozenset(kind.joints), 0) + count
            orders.setdefault(frozenset(kind.joints), kind.joints)
    if not numbers:
        raise invalid_data(f"topic {topic}", "without positions", "messages that tell the position of joints")
    if wanted is not None:
        if any(each.issuperset(wanted) for each in numbers):
            return wanted
        known = sorted(set().union(*numbers))
        raise invalid_data("joint_names", ", ".join(wanted), f"joints out of {_listed(known)}, told together")

    def weight(joints: frozenset[str]) -> int:
        return len(joints) ** 2 * sum(count for other, count in numbers.items() if other >= joints)

    return orders[max(numbers, key=weight)]


def describe(
    kinds: Sequence[Kind], counts: Sequence[int], joints: tuple[str, ...], quantities: Mapping[str, int]
) -> list[str]:
    """What is to be told of the choice, in sentences. quantities: number of messages that hold each."""
    facts = []
    read = [(kind, count) for kind, count in zip(kinds, counts, strict=True) if holds(kind, joints)]
    total, kept = sum(counts), sum(count for _, count in read)
    if kept < total:
        others = {joint for kind in kinds for joint in kind.joints} - set(joints)
        also = f" (others tell of {_listed(sorted(others))})" if others else ""
        facts.append(f"{total - kept} of {total} messages do not tell of all joints and were left out{also}")
    elif others := {joint for kind, _ in read for joint in kind.joints} - set(joints):
        facts.append(f"joints {_listed(sorted(others))} were left out")
    orders = {tuple(joint for joint in kind.joints if joint in joints) for kind, _ in read}
    if len(orders) > 1:
        facts.append(f"the joints come in {len(orders)} orders: they were matched by name in every message")
    facts += [
        f"{kept - count} of {kept} messages have no {quantity}"
        for quantity, count in quantities.items()
        if 0 < count < kept
    ]
    return facts


def holds(kind: Kind, joints: tuple[str, ...]) -> bool:
    """Whether messages of a kind tell the position of all these joints."""
    return "position" in kind.quantities and set(kind.joints).issuperset(joints)


def _listed(joints: Sequence[str]) -> str:
    return ", ".join(readable(joint[:100]) for joint in joints[:20]) + (" …" if len(joints) > 20 else "")
