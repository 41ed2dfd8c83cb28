"""Which joints are read, if the messages of a topic hold different ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from service.foundation.errors import invalid_data, readable


@dataclass(frozen=True)
class MessageKind:
    """The joints and quantities that some messages of a topic hold."""

    joints: tuple[str, ...]
    quantities: tuple[str, ...]
    """Of q, dq, ddq and tau; none if the messages lack what the topic is read for."""
    named: bool = True
    """Whether the joint names come from the messages; otherwise joints are numbered."""


def choose_joints(
    kinds: Sequence[MessageKind], counts: Sequence[int], given: tuple[str, ...] | None, topic: str
) -> tuple[str, ...]:
    """Return the joints to read: those `given`, or the set with the largest weight; raise InvalidDataError.

    The weight of a set is the number of messages with all its joints times the square of its size. An arm at 30 Hz then
    wins over its gripper at 200 Hz. counts: messages of each kind.
    """
    numbers: dict[frozenset[str], int] = {}
    orders: dict[frozenset[str], tuple[str, ...]] = {}
    for kind, count in sorted(zip(kinds, counts, strict=True), key=lambda each: -each[1]):
        if kind.quantities:
            numbers[frozenset(kind.joints)] = numbers.get(frozenset(kind.joints), 0) + count
            orders.setdefault(frozenset(kind.joints), kind.joints)
    if not numbers:
        raise invalid_data(f"topic {topic}", "without numbers", "messages with numbers of each joint")
    if given is not None:
        if any(each.issuperset(given) for each in numbers):
            return given
        known = sorted(set().union(*numbers))
        raise invalid_data(
            "joint_names", ", ".join(given), f"joints out of {_listed(known)} that are in the same message"
        )

    def weight(joints: frozenset[str]) -> int:
        return len(joints) ** 2 * sum(count for other, count in numbers.items() if other >= joints)

    return orders[max(numbers, key=weight)]


def describe_choice(
    kinds: Sequence[MessageKind], counts: Sequence[int], joints: tuple[str, ...], quantities: Mapping[str, int]
) -> list[str]:
    """Return sentences about the joints that are read. quantities: number of messages that hold each."""
    facts = []
    read = [(kind, count) for kind, count in zip(kinds, counts, strict=True) if has_joints(kind, joints)]
    total, kept = sum(counts), sum(count for _, count in read)
    if kept < total:
        others = {joint for kind in kinds for joint in kind.joints} - set(joints)
        also = f"; other joints of the topic: {_listed(sorted(others))}" if others else ""
        facts.append(f"{total - kept} of {total} messages do not have all joints and were not read{also}")
    elif others := {joint for kind, _ in read for joint in kind.joints} - set(joints):
        facts.append(f"joints not read: {_listed(sorted(others))}")
    orders = {tuple(joint for joint in kind.joints if joint in joints) for kind, _ in read}
    if len(orders) > 1:
        facts.append(f"the joints come in {len(orders)} different orders and were matched by name in every message")
    facts += [
        f"{kept - count} of {kept} messages have no {quantity}"
        for quantity, count in quantities.items()
        if 0 < count < kept
    ]
    return facts


def has_joints(kind: MessageKind, joints: tuple[str, ...]) -> bool:
    """Return whether messages of a kind have numbers of all these joints."""
    return bool(kind.quantities) and set(kind.joints).issuperset(joints)


def _listed(joints: Sequence[str]) -> str:
    return ", ".join(readable(joint[:100]) for joint in joints[:20]) + (" …" if len(joints) > 20 else "")
