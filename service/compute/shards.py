"""Sums over shards: computed by whoever has time, added in one order, so that the sum does not depend on who that was.

Shard k's result is added to those before it as a binary counter counts: two neighbours make a pair, two pairs a four.
Floating-point sums depend on their order, and this one is given by the number of shards alone. No more results are kept
than the counter has digits, and those that are ahead of their turn.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from typing import Any, Protocol, Self, TypeVar

from lipcore.fitting.hyperparameters import FitCancelledError
from service.compute.executors import lost

logger = logging.getLogger(__name__)

POLL_S = 0.1
"""Seconds between two looks at whether to stop."""
AHEAD = 32
"""Shards that are in work, or wait for their turn to be added: so many workers have something to do, and so many
results are in memory at most."""


class Addable(Protocol):
    """What a shard comes to."""

    def __add__(self, other: Self, /) -> Self:
        """The sum of two; it may be another one in another order."""
        ...


Shard = TypeVar("Shard")
Sum = TypeVar("Sum", bound=Addable)


class ShardFailedError(RuntimeError):
    """A shard could not be computed: its workers were lost again and again."""


class Tree(list[tuple[int, Any]]):
    """Sums of 2^k neighbours each, the larger ones first: (k, sum). Results are added in the order of their shards."""

    def add(self, result: Any) -> None:
        """Take the next shard's result."""
        level = 0
        while self and self[-1][0] == level:
            result, level = self.pop()[1] + result, level + 1
        self.append((level, result))

    def sum(self) -> Any:
        """The sum of all; raise ValueError where there is none."""
        if not self:
            raise ValueError("no shards: expected at least one")
        total = self[-1][1]
        for _, each in reversed(self[:-1]):
            total = each + total
        return total


def summed(
    executor: Executor,
    work: Callable[[Shard], Sum],
    shards: Sequence[Shard],
    cancelled: Callable[[], bool],
    attempts: int = 3,
    done: Callable[[int], None] | None = None,
) -> Sum:
    """Sum of what `work` makes of each shard: the same to the last bit, whoever computes which shard when.

    work: a function at the top of a module, of plain data; cancelled: asked often while this waits; attempts: how often
    a shard is computed whose worker is lost; done: told how many are added.
    Raise FitCancelledError when `cancelled` says so, ShardFailedError, or what `work` raises.
    """
    running: dict[Future[Sum], int] = {}
    tries, again, results, tree = [0] * len(shards), list[int](), dict[int, Sum](), Tree()
    begun = added = 0
    try:
        while added < len(shards):
            if cancelled():
                raise FitCancelledError("cancelled while the samples were summed up")
            more = again or (begun < len(shards) and begun < added + AHEAD)
            if more:  # one at a time: an executor may do it at once
                number = again.pop(0) if again else begun
                begun = max(begun, number + 1)
                if tries[number] == attempts:
                    message = f"shard {number + 1} of {len(shards)}: its worker was lost {attempts} times"
                    raise ShardFailedError(message)
                tries[number] += 1
                running[executor.submit(work, shards[number])] = number
            for future in wait(running, 0 if more else POLL_S, FIRST_COMPLETED).done:
                number, error = running.pop(future), _error(future)
                if error is None:
                    results[number] = future.result()
                elif lost(error):
                    logger.warning("shard %d of %d is computed again: %s", number + 1, len(shards), _reason(error))
                    again.append(number)
                else:
                    raise error
            while added in results:
                tree.add(results.pop(added))
                added += 1
                if done is not None:
                    done(added)
        total: Sum = tree.sum()
        return total
    finally:
        for future in running:
            future.cancel()


def _error(future: Future[Any]) -> BaseException | None:
    try:
        return future.exception()
    except CancelledError as error:
        return error


def _reason(error: BaseException) -> str:
    return str(error) or type(error).__name__
