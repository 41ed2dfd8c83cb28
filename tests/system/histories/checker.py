"""A linearizability checker: is there one order of the operations in which each takes effect at once?

The search of Wing and Gong (1993) with the memory of Lowe (2017): order the operations one by one; the next one must
have begun before any of the remaining ones ended. Positions with the same completed operations and state are searched
once.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from math import inf
from operator import le
from typing import Any

UNKNOWN = "unknown"
"""Result of an operation without a response: it took effect at any time after its start, or never."""
State = Hashable
Step = Callable[[Any, "Operation"], Iterable[State]]
"""Returns the possible states after an operation, given its state before and result; none if they contradict."""


IsReadOnly = Callable[["Operation"], bool]
"""Returns whether an answered operation leaves every state unchanged."""


def never_read_only(_: Operation) -> bool:
    """Return False: every operation may change the state."""
    return False


@dataclass(frozen=True)
class Operation:
    """An operation of a client and its result. key: resource; began, ended: seconds of one clock."""

    client: int
    key: str
    call: tuple[Any, ...]
    result: Any
    began: float
    ended: float

    @property
    def answered(self) -> bool:
        """Whether a response arrived."""
        return self.result != UNKNOWN


@dataclass(frozen=True)
class _Progress:
    """Operations ordered so far: the answered ones before `first`, those in the bit set `beyond` (from `first` on), and
    the number of unanswered ones of each kind."""

    first: int
    beyond: int
    unknown: tuple[int, ...]

    def with_answered(self, index: int) -> _Progress:
        beyond = self.beyond | 1 << (index - self.first)
        run = (~beyond & (beyond + 1)).bit_length() - 1  # consecutive ones from `first` on
        return _Progress(self.first + run, beyond >> run, self.unknown)

    def with_unknown(self, kind: int) -> _Progress:
        return _Progress(
            self.first, self.beyond, (*self.unknown[:kind], self.unknown[kind] + 1, *self.unknown[kind + 1 :])
        )


class _Search:
    """Searches the operations of one key. Unanswered operations with the same call are of one kind: they are
    interchangeable once they have begun, so that only their number counts."""

    def __init__(self, history: Sequence[Operation], step: Step, is_read_only: IsReadOnly) -> None:
        ordered = sorted(history, key=lambda each: each.began)
        self.answered = [each for each in ordered if each.answered]
        by_call: dict[tuple[Any, ...], list[Operation]] = {}
        for each in ordered:
            if not each.answered:
                by_call.setdefault(each.call, []).append(each)
        self.kinds = list(by_call.values())
        self.start_times = [[each.began for each in kind] for kind in self.kinds]
        self.step, self.is_read_only = step, is_read_only
        self.reached: dict[tuple[int, int, State], list[tuple[int, ...]]] = {}

    def is_new(self, progress: _Progress, state: State) -> bool:
        """Return whether a position must be searched, and remember it. A position that was reached with no more
        unanswered operations of any kind covers it."""
        counts = self.reached.setdefault((progress.first, progress.beyond, state), [])
        if any(all(map(le, fewer, progress.unknown)) for fewer in counts):
            return False
        counts.append(progress.unknown)
        return True

    def next_steps(self, progress: _Progress, state: State) -> Iterator[tuple[Operation, _Progress, State]]:
        """Yield the operations that may come next, with progress and state after them: those that began before any
        remaining one ended. A read-only one that fits is taken at once, which loses no order. Unanswered ones come
        last, because few are needed."""
        limit, waiting = inf, []
        for index in range(progress.first, len(self.answered)):
            if progress.beyond >> (index - progress.first) & 1:
                continue
            if self.answered[index].began > limit:
                break
            limit = min(limit, self.answered[index].ended)
            waiting.append(index)
        possible = [index for index in waiting if self.answered[index].began <= limit]
        for index in possible:
            if self.is_read_only(self.answered[index]) and list(self.step(state, self.answered[index])):
                yield self.answered[index], progress.with_answered(index), state
                return
        for index in possible:
            for after in self.step(state, self.answered[index]):
                yield self.answered[index], progress.with_answered(index), after
        for number, kind in enumerate(self.kinds):
            if (used := progress.unknown[number]) < bisect_right(self.start_times[number], limit):
                for after in self.step(state, kind[used]):
                    if after != state:  # without an effect it may be left out
                        yield kind[used], progress.with_unknown(number), after


def find_order(
    history: Sequence[Operation], initial: State, step: Step, is_read_only: IsReadOnly = never_read_only
) -> list[Operation] | None:
    """Return an order that explains the operations of one key, or None.

    Unanswered operations without an effect are left out. initial: state before the history.
    """
    search = _Search(history, step, is_read_only)
    order: list[Operation] = []
    if not search.answered:
        return []
    levels = [search.next_steps(_Progress(0, 0, (0,) * len(search.kinds)), initial)]
    while levels:
        for operation, progress, state in levels[-1]:
            if not search.is_new(progress, state):
                continue
            order.append(operation)
            if progress.first == len(search.answered):
                return order
            levels.append(search.next_steps(progress, state))
            break
        else:
            levels.pop()
            if order:
                order.pop()
    return None


def find_contradictions(
    history: Iterable[Operation], initial: State, step: Step, is_read_only: IsReadOnly = never_read_only
) -> list[str]:
    """Return the keys whose operations no order explains."""
    by_key: dict[str, list[Operation]] = {}
    for each in history:
        by_key.setdefault(each.key, []).append(each)
    return [key for key, each in by_key.items() if find_order(each, initial, step, is_read_only) is None]
