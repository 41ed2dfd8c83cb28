"""Whether concurrent operations can be explained by one order in which each takes effect at once: linearizability.

Wing & Gong's search (1993) with the memory of Lowe (2017): operations are put in order one by one, each of them one
that had begun before any of the rest ended; what was tried with the same operations done and the same state reached is
not tried again.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

UNKNOWN = "unknown"
"""Result of an operation whose answer never came: it took effect at any time since it began, or never."""
State = Hashable
Step = Callable[[Any, "Operation"], Iterable[State]]
"""States that an operation may leave behind, given the one before and the result: none where it contradicts it."""


@dataclass(frozen=True)
class Operation:
    """What a client asked for, and what it was told. began, ended: s, of one clock; key: of what it is about."""

    client: int
    key: str
    call: tuple[Any, ...]
    result: Any
    began: float
    ended: float

    @property
    def certain(self) -> bool:
        """Whether an answer came."""
        return self.result != UNKNOWN


def explained(history: Sequence[Operation], initial: State, step: Step) -> list[Operation] | None:
    """An order that explains a history, operations without an answer left out where they need not have happened.

    None where there is no such order. history: of one key; initial: state before it.
    """
    operations = sorted(history, key=lambda each: each.began)
    ends = [each.ended if each.certain else inf for each in operations]
    needed = sum(1 << index for index, each in enumerate(operations) if each.certain)
    seen: set[tuple[int, State]] = set()
    done, order = 0, []
    levels = [_next(operations, ends, 0, done, initial, step)]
    while levels:
        if done & needed == needed:
            return [operations[index] for index in order]
        for index, state in levels[-1]:
            now = done | 1 << index
            if (now, state) not in seen:
                seen.add((now, state))
                done = now
                order.append(index)
                levels.append(_next(operations, ends, 0, done, state, step))
                break
        else:
            levels.pop()
            if order:
                done &= ~(1 << order.pop())
    return None


def _next(
    operations: Sequence[Operation], ends: Sequence[float], first: int, done: int, state: State, step: Step
) -> Iterator[tuple[int, State]]:
    """Operations that may come next, and the states after them: those that began before any of the rest ended."""
    limit = inf
    waiting = []
    for index in range(first, len(operations)):
        if done >> index & 1:
            continue
        if operations[index].began > limit:
            break
        limit = min(limit, ends[index])
        waiting.append(index)
    for index in waiting:
        if operations[index].began <= limit:
            for after in step(state, operations[index]):
                yield index, after


def contradictions(history: Iterable[Operation], initial: State, step: Step) -> list[str]:
    """Keys whose operations nothing explains."""
    by_key: dict[str, list[Operation]] = {}
    for each in history:
        by_key.setdefault(each.key, []).append(each)
    return [key for key, each in by_key.items() if explained(each, initial, step) is None]
