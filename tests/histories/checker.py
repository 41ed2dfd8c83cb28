"""Whether concurrent operations can be explained by one order in which each takes effect at once: linearizability.

Wing & Gong's search (1993) with the memory of Lowe (2017): operations are put in order one by one, each of them one
that had begun before any of the rest ended; what was tried with the same operations done and the same state reached is
not tried again.
"""

from __future__ import annotations

from bisect import bisect_right
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


@dataclass(frozen=True)
class _Done:
    """Operations that are put in order: the certain ones before `first`, those of `beyond` (bits from `first` on), and
    of those without an answer the bits of `unknown`."""

    first: int = 0
    beyond: int = 0
    unknown: int = 0

    def with_certain(self, index: int) -> _Done:
        beyond = self.beyond | 1 << (index - self.first)
        run = (~beyond & (beyond + 1)).bit_length() - 1  # how many follow each other from `first` on
        return _Done(self.first + run, beyond >> run, self.unknown)

    def with_unknown(self, index: int) -> _Done:
        return _Done(self.first, self.beyond, self.unknown | 1 << index)


class _Search:
    def __init__(self, history: Sequence[Operation], step: Step) -> None:
        ordered = sorted(history, key=lambda each: each.began)
        self.certain = [each for each in ordered if each.certain]
        self.unknown = [each for each in ordered if not each.certain]
        self.begins = [each.began for each in self.unknown]
        self.step = step

    def following(self, done: _Done, state: State) -> Iterator[tuple[Operation, _Done, State]]:
        """Operations that may come next and what they lead to: those that began before any of the rest ended. Those
        without an answer come last, the latest of them first: few of them are needed."""
        limit, waiting = inf, []
        for index in range(done.first, len(self.certain)):
            if done.beyond >> (index - done.first) & 1:
                continue
            if self.certain[index].began > limit:
                break
            limit = min(limit, self.certain[index].ended)
            waiting.append(index)
        for index in waiting:
            if self.certain[index].began <= limit:
                for after in self.step(state, self.certain[index]):
                    yield self.certain[index], done.with_certain(index), after
        for index in range(bisect_right(self.begins, limit) - 1, -1, -1):
            if not done.unknown >> index & 1:
                for after in self.step(state, self.unknown[index]):
                    if after != state:  # else it need not have happened
                        yield self.unknown[index], done.with_unknown(index), after


def explained(history: Sequence[Operation], initial: State, step: Step) -> list[Operation] | None:
    """An order that explains a history, operations without an answer left out where they need not have happened.

    None where there is no such order. history: of one key; initial: state before it.
    """
    search = _Search(history, step)
    seen: set[tuple[_Done, State]] = set()
    order: list[Operation] = []
    if not search.certain:
        return []
    levels = [search.following(_Done(), initial)]
    while levels:
        for operation, done, state in levels[-1]:
            if (done, state) in seen:
                continue
            seen.add((done, state))
            order.append(operation)
            if done.first == len(search.certain):
                return order
            levels.append(search.following(done, state))
            break
        else:
            levels.pop()
            if order:
                order.pop()
    return None


def contradictions(history: Iterable[Operation], initial: State, step: Step) -> list[str]:
    """Keys whose operations nothing explains."""
    by_key: dict[str, list[Operation]] = {}
    for each in history:
        by_key.setdefault(each.key, []).append(each)
    return [key for key, each in by_key.items() if explained(each, initial, step) is None]
