"""Executors of shards: this process, processes of this host, or workers of a Dask cluster; and reproducible sums.

A shard's work is a function of a module with plain data. On a cluster it runs on another host, which has settings of
its own: see `choose_settings`.

Results are added like the digits of a binary counter: two neighbours make a pair, two pairs a four. A floating-point
sum depends on its order, and here only the number of shards sets the order. Memory contains one result per digit of the
counter, and the results that wait for their turn.
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
from lipcore.extras import import_extra
from service.foundation.settings import Settings
from service.runtime import remote
from service.runtime.process import ProcessOptions, start_process
from service.runtime.progress import CHECK_S, HEARTBEAT_S, Progress
from service.telemetry import logs

P = ParamSpec("P")
T = TypeVar("T")

SHARD, GPU_SHARD = "SHARD", "GPU_SHARD"
"""Tags of workers that compute shards. A job occupies its worker's GPU and meanwhile submits shards on GPUs. These have
a tag of their own; otherwise they would wait for the end of their job."""


class ClusterUnavailableError(RuntimeError):
    """The scheduler of the cluster cannot be reached now; retry later."""


@contextmanager
def shard_executor(settings: Settings, gpu: bool = False) -> Iterator[Executor]:
    """Yield an executor for the shards of one pass; cancel unfinished shards at the end.

    gpu: the shards need a GPU. They run on workers of a cluster that have one, or in this process.

    A shard of a lost worker ends with an error that `is_worker_lost` recognises. Submit it again to the same
    executor. Raise ClusterUnavailableError.
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


def is_worker_lost(error: BaseException | None) -> bool:
    """Return whether an error means that the worker is gone, not that the shard failed."""
    if isinstance(error, BrokenProcessPool | CancelledError):
        return True
    # by name: its module is an extra
    return any(kind.__name__ in {"KilledWorker", "FutureCancelledError"} for kind in type(error).__mro__)


class Inline(Executor):
    """Runs every call at once, in the submitting thread."""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Call the function; return a finished future."""
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class Processes(Executor):
    """Processes of this host with the priority and CPUs of this one. Broken pools are replaced, hung ones killed."""

    def __init__(self, settings: Settings) -> None:
        self._new = partial(
            ProcessPoolExecutor,
            settings.statistics_workers,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=start_process,
            # niceness, policy and CPUs are inherited; threads must be set before numerics are imported
            initargs=(ProcessOptions(settings.training_threads, log=logs.current_options()),),
        )
        self._pool = self._new()
        self._progress = Progress(lambda: [each.pid for each in self._processes() if each.pid], HEARTBEAT_S, inf)
        self._looked = time.monotonic()

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Submit a call to the next free process."""
        try:
            future = self._pool.submit(fn, *args, **kwargs)
        except BrokenProcessPool:
            self._pool.shutdown(wait=False, cancel_futures=True)
            self._pool = self._new()
            self._progress.step()
            future = self._pool.submit(fn, *args, **kwargs)
        future.add_done_callback(lambda _: self._progress.step())
        return future

    def check(self) -> None:
        """Kill all processes if none makes progress for HEARTBEAT_S while work waits. Call it often."""
        if time.monotonic() - self._looked < CHECK_S / 4:
            return
        self._looked = time.monotonic()
        if (reason := self._progress.check()) is not None:
            logger.error("processes that compute statistics hang and are killed: %s", reason)
            self._progress.step()
            for process in self._processes():
                process.kill()

    def _processes(self) -> list[BaseProcess]:
        # no public attribute has the processes; `kill_workers` of Python 3.14 may wait
        return list((self._pool._processes or {}).values())

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Cancel waiting calls; without `wait`, kill the processes."""
        processes = self._processes()
        self._pool.shutdown(wait=wait, cancel_futures=cancel_futures)
        if not wait:
            for process in processes:
                process.kill()


class Workers(Executor):
    """Workers of a cluster, through its own executor."""

    def __init__(self, executor: Any) -> None:
        self._executor = executor

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Submit a call to a worker; raise ClusterUnavailableError if the scheduler is gone."""
        packed = remote.pack(fn, *args, **kwargs)
        try:
            future: Future[T] = self._executor.submit(remote.call, packed)
        except Exception as error:  # a closed client raises many kinds of errors
            raise ClusterUnavailableError(f"the scheduler of the cluster is gone: {error}") from None
        return future


def connect(address: str, name: str = "lipserve") -> Any:
    """Return a client of a cluster's scheduler. Raise ClusterUnavailableError, MissingExtraError."""
    distributed = import_extra("distributed", "cluster", "LIPSERVE_CLUSTER is set")
    new: Any = distributed.Client
    logging.getLogger("distributed").setLevel(logging.WARNING)  # its import has set another level
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


def set_worker_settings(settings: Settings) -> None:
    """Make this process a worker of a cluster, with settings of its own."""
    global _placed  # noqa: PLW0603 - a worker is a process
    _placed = settings


def choose_settings(sent: Settings | None) -> Settings:
    """Return the settings for a shard: on a cluster worker its own home, database and files, else the settings sent."""
    if _placed is not None:
        return _placed
    if sent is None:
        raise RuntimeError("a shard has no settings, and this process is no cluster worker")
    return sent


def settings_to_send(settings: Settings) -> Settings | None:
    """Return the settings to send with a shard; None for a cluster: its workers have their own. Secrets stay here."""
    return None if settings.cluster is not None else settings


logger = logging.getLogger(__name__)

POLL_S = 0.1
"""Seconds between two checks for cancellation."""
MAX_SHARDS_AHEAD = 32
"""Max shards in work or waiting to be added: it bounds both the busy workers and the results in memory."""


class Addable(Protocol):
    """The result of a shard."""

    def __add__(self, other: Self, /) -> Self:
        """Return the sum of two results; it may depend on their order."""
        ...


Shard = TypeVar("Shard")
Sum = TypeVar("Sum", bound=Addable)


class ShardFailedError(RuntimeError):
    """A shard could not be computed: its workers were lost repeatedly."""


class Tree(list[tuple[int, Any]]):
    """Sums of 2^k neighbours each as (k, sum), larger ones first. Results are added in the order of their shards."""

    def add(self, result: Any) -> None:
        """Add the next shard's result."""
        level = 0
        while self and self[-1][0] == level:
            result, level = self.pop()[1] + result, level + 1
        self.append((level, result))

    def sum(self) -> Any:
        """Return the sum of all results; raise ValueError if there are none."""
        if not self:
            raise ValueError("no shards: expected at least one")
        total = self[-1][1]
        for _, each in reversed(self[:-1]):
            total = each + total
        return total


def sum_shards(
    executor: Executor,
    work: Callable[[Shard], Sum],
    shards: Sequence[Shard],
    cancelled: Callable[[], bool],
    attempts: int = 3,
    done: Callable[[int], None] | None = None,
) -> Sum:
    """Return the sum of `work` over all shards: the same to the last bit, on any workers and in any timing.

    - work: a function at the top of a module, of plain data.
    - cancelled: called often during the wait.
    - attempts: max times that a shard is computed if its worker is lost.
    - done: called with the number of added shards.

    Raise FitCancelledError if `cancelled` returns True, ShardFailedError, or any error of `work`.
    """
    running: dict[Future[Sum], int] = {}
    tries, again, results, tree = [0] * len(shards), list[int](), dict[int, Sum](), Tree()
    begun = added = 0
    try:
        while added < len(shards):
            if cancelled():
                raise FitCancelledError("cancelled while statistics were computed")
            more = again or (begun < len(shards) and begun < added + MAX_SHARDS_AHEAD)
            if more:  # one at a time: an executor may run it at once
                number = again.pop(0) if again else begun
                begun = max(begun, number + 1)
                if tries[number] == attempts:
                    message = f"shard {number + 1} of {len(shards)}: its worker was lost {attempts} times"
                    raise ShardFailedError(message)
                tries[number] += 1
                running[executor.submit(work, shards[number])] = number
            if isinstance(executor, Processes):
                executor.check()
            for future in wait(running, 0 if more else POLL_S, FIRST_COMPLETED).done:
                number, error = running.pop(future), _error(future)
                if error is None:
                    results[number] = future.result()
                elif is_worker_lost(error):
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
