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
from operator import le
from typing import Any

UNKNOWN = "unknown"
"""Result of an operation whose answer never came: it took effect at any time since it began, or never."""
State = Hashable
Step = Callable[[Any, "Operation"], Iterable[State]]
"""States that an operation may leave behind, given the one before and the result: none where it contradicts it."""


Looks = Callable[["Operation"], bool]
"""Whether an operation with an answer leaves every state as it is."""


def never(_: Operation) -> bool:
    """Of things whose operations may all change something."""
    return False


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
    so many of each kind of those without an answer."""

    first: int
    beyond: int
    unknown: tuple[int, ...]

    def with_certain(self, index: int) -> _Done:
        beyond = self.beyond | 1 << (index - self.first)
        run = (~beyond & (beyond + 1)).bit_length() - 1  # how many follow each other from `first` on
        return _Done(self.first + run, beyond >> run, self.unknown)

    def with_unknown(self, kind: int) -> _Done:
        return _Done(self.first, self.beyond, (*self.unknown[:kind], self.unknown[kind] + 1, *self.unknown[kind + 1 :]))


class _Search:
    """Operations of one key. Those without an answer that ask for the same are of one kind: once they have begun, each
    may stand for each other, and how many have taken effect is all that counts."""

    def __init__(self, history: Sequence[Operation], step: Step, looks: Looks) -> None:
        ordered = sorted(history, key=lambda each: each.began)
        self.certain = [each for each in ordered if each.certain]
        by_call: dict[tuple[Any, ...], list[Operation]] = {}
        for each in ordered:
            if not each.certain:
                by_call.setdefault(each.call, []).append(each)
        self.kinds = list(by_call.values())
        self.begins = [[each.began for each in kind] for kind in self.kinds]
        self.step, self.looks = step, looks
        self.reached: dict[tuple[int, int, State], list[tuple[int, ...]]] = {}

    def is_new(self, done: _Done, state: State) -> bool:
        """Whether a place is to be searched, which is noted: not where it was reached with no more of any kind, as who
        has used fewer can do all that the other can."""
        counts = self.reached.setdefault((done.first, done.beyond, state), [])
        if any(all(map(le, fewer, done.unknown)) for fewer in counts):
            return False
        counts.append(done.unknown)
        return True

    def following(self, done: _Done, state: State) -> Iterator[tuple[Operation, _Done, State]]:
        """Operations that may come next and what they lead to: those that began before any of the rest ended. One
        that only looks, and fits, comes next: nothing is lost by that. Those without an answer come last: few of them
        are needed."""
        limit, waiting = inf, []
        for index in range(done.first, len(self.certain)):
            if done.beyond >> (index - done.first) & 1:
                continue
            if self.certain[index].began > limit:
                break
            limit = min(limit, self.certain[index].ended)
            waiting.append(index)
        possible = [index for index in waiting if self.certain[index].began <= limit]
        for index in possible:
            if self.looks(self.certain[index]) and list(self.step(state, self.certain[index])):
                yield self.certain[index], done.with_certain(index), state
                return
        for index in possible:
            for after in self.step(state, self.certain[index]):
                yield self.certain[index], done.with_certain(index), after
        for number, kind in enumerate(self.kinds):
            if (used := done.unknown[number]) < bisect_right(self.begins[number], limit):
                for after in self.step(state, kind[used]):
                    if after != state:  # else it need not have happened
                        yield kind[used], done.with_unknown(number), after


def explained(history: Sequence[Operation], initial: State, step: Step, looks: Looks = never) -> list[Operation] | None:
    """An order that explains a history, operations without an answer left out where they need not have happened.

    None where there is no such order. history: of one key; initial: state before it.
    """
    search = _Search(history, step, looks)
    order: list[Operation] = []
    if not search.certain:
        return []
    levels = [search.following(_Done(0, 0, (0,) * len(search.kinds)), initial)]
    while levels:
        for operation, done, state in levels[-1]:
            if not search.is_new(done, state):
                continue
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


def contradictions(history: Iterable[Operation], initial: State, step: Step, looks: Looks = never) -> list[str]:
    """Keys whose operations nothing explains."""
    by_key: dict[str, list[Operation]] = {}
    for each in history:
        by_key.setdefault(each.key, []).append(each)
    return [key for key, each in by_key.items() if explained(each, initial, step, looks) is None]
