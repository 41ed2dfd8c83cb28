"""Executors for shards of work: this process, processes of this host, or workers of a Dask cluster; and sums over
shards that do not depend on who computes which.

Work that is given to them has to be a function of a module, with plain data. On a cluster it runs on another host,
whose settings are its own: see `placed`.

Shard k's result is added to those before it as a binary counter counts: two neighbours make a pair, two pairs a four.
Floating-point sums depend on their order, and this one is given by the number of shards alone. No more results are kept
than the counter has digits, and those that are ahead of their turn.
"""

from __future__ import annotations

import logging
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from math import inf
from multiprocessing.process import BaseProcess
from typing import Any, ParamSpec, Protocol, Self, TypeVar

from lipcore.estimators.hyperparameters import FitCancelledError
from lipcore.extras import need
from service.foundation.settings import Settings
from service.runtime import remote
from service.runtime.process import Place, start_process
from service.runtime.progress import HEARTBEAT_S, LOOK_S, Progress
from service.telemetry import logs

P = ParamSpec("P")
T = TypeVar("T")

SHARD, GPU_SHARD = "SHARD", "GPU_SHARD"
"""Tags of workers that take shards. A job holds its worker's GPU while it lasts, and asks for shards on GPUs
meanwhile: these have a tag of their own, or they would wait for their job's end."""


class ClusterUnavailableError(RuntimeError):
    """The scheduler of the cluster cannot be reached: another time it may be."""


@contextmanager
def shard_executor(settings: Settings, gpu: bool = False) -> Iterator[Executor]:
    """An executor for the shards of one pass; what still waits or runs at the end is given up.

    gpu: the shards need one: workers of a cluster that have one, else this process. A shard whose worker was lost ends
    with an error that `lost` knows; it can be submitted again at once, to the same executor.
    Raise ClusterUnavailableError.
    """
    if settings.cluster is not None:
        with _workers(settings.cluster, {SHARD: 1, GPU_SHARD: 1} if gpu else {SHARD: 1}) as executor:
            yield executor
        return
    local = Inline() if gpu or settings.statistics_workers == 1 else Processes(settings)
    try:
        yield local
    finally:
        local.shutdown(wait=False, cancel_futures=True)


def lost(error: BaseException | None) -> bool:
    """Whether a shard has not failed, but its worker is gone."""
    if isinstance(error, BrokenProcessPool | CancelledError):
        return True
    # by name: its module is an extra
    return any(kind.__name__ in {"KilledWorker", "FutureCancelledError"} for kind in type(error).__mro__)


class Inline(Executor):
    """Does everything at once, in the thread that submits."""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Call the function; return a future that has ended."""
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class Processes(Executor):
    """Processes of this host in the place of this one: as nice, on the same CPUs. A pool that broke is replaced, one
    that hangs is broken."""

    def __init__(self, settings: Settings) -> None:
        self._new = partial(
            ProcessPoolExecutor,
            settings.statistics_workers,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=start_process,
            # niceness, policy and CPUs are inherited; threads are told before numerics are imported
            initargs=(Place(settings.training_threads, log=logs.current()),),
        )
        self._pool = self._new()
        self._progress = Progress(lambda: [each.pid for each in self._processes() if each.pid], HEARTBEAT_S, inf)
        self._looked = time.monotonic()

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Hand a call to the next free process."""
        try:
            future = self._pool.submit(fn, *args, **kwargs)
        except BrokenProcessPool:
            self._pool.shutdown(wait=False, cancel_futures=True)
            self._pool = self._new()
            self._progress.step()
            future = self._pool.submit(fn, *args, **kwargs)
        future.add_done_callback(lambda _: self._progress.step())
        return future

    def look(self) -> None:
        """End all processes where none of them has got on for HEARTBEAT_S while work waits: one that others wait
        for hangs. To be asked often."""
        if time.monotonic() - self._looked < LOOK_S / 4:
            return
        self._looked = time.monotonic()
        if (reason := self._progress.look()) is not None:
            logger.error("processes that sum up statistics hang and are killed: %s", reason)
            self._progress.step()
            for process in self._processes():
                process.kill()

    def _processes(self) -> list[BaseProcess]:
        # there is no public way to them: `kill_workers` of Python 3.14 may wait
        return list((self._pool._processes or {}).values())

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Give up what waits; without `wait` the processes are ended, whatever they do."""
        processes = self._processes()
        self._pool.shutdown(wait=wait, cancel_futures=cancel_futures)
        if not wait:
            for process in processes:
                process.kill()


class Workers(Executor):
    """Workers of a cluster, by its own executor."""

    def __init__(self, executor: Any) -> None:
        self._executor = executor

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Hand a call to a worker; raise ClusterUnavailableError where the scheduler is gone."""
        packed = remote.pack(fn, *args, **kwargs)
        try:
            future: Future[T] = self._executor.submit(remote.call, packed)
        except Exception as error:  # a client that has given up says so in many ways
            raise ClusterUnavailableError(f"the scheduler of the cluster is gone: {error}") from None
        return future


def connect(address: str, name: str = "lipserve") -> Any:
    """A client of a cluster's scheduler. Raise ClusterUnavailableError, MissingExtraError."""
    distributed = need("distributed", "cluster", "LIPSERVE_CLUSTER is set")
    new: Any = distributed.Client
    logging.getLogger("distributed").setLevel(logging.WARNING)  # importing it has set another one
    try:
        return new(address, timeout=10.0, set_as_default=False, direct_to_workers=True, name=name)
    except (OSError, TimeoutError, ValueError) as error:
        raise ClusterUnavailableError(f"the scheduler {address} of the cluster cannot be reached: {error}") from None


@contextmanager
def _workers(address: str, resources: dict[str, int]) -> Iterator[Executor]:
    client = connect(address)
    try:
        executor = client.get_executor(resources=resources, pure=False)
        yield Workers(executor)
        executor.shutdown(wait=False)
    finally:
        client.close(timeout=1.0)


_placed: Settings | None = None


def place(settings: Settings) -> None:
    """Say that this process is a worker of a cluster, with settings of its own."""
    global _placed  # noqa: PLW0603 - a worker is a process
    _placed = settings


def placed(sent: Settings | None) -> Settings:
    """Settings that a shard works with: its worker's own on a cluster (home, database, files), else those sent."""
    if _placed is not None:
        return _placed
    if sent is None:
        raise RuntimeError("a shard without settings, in a process that is no worker of a cluster")
    return sent


def sent(settings: Settings) -> Settings | None:
    """Settings to send with a shard: none to a cluster, whose workers have their own; secrets stay where they are."""
    return None if settings.cluster is not None else settings


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
            if isinstance(executor, Processes):
                executor.look()
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
