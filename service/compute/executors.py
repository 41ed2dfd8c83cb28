"""Executors for shards of work: this process, processes of this host, or workers of a Dask cluster.

Work that is given to them has to be a function of a module, with plain data. On a cluster it runs on another host,
whose settings are its own: see `placed`.
"""

from __future__ import annotations

import logging
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from typing import Any, ParamSpec, TypeVar

from service.compute import remote
from service.compute.process import Place, start_process
from service.foundation.settings import Settings
from service.web.observability import logs

P = ParamSpec("P")
T = TypeVar("T")

CONNECT_S = 10.0
"""Longest wait in s for the scheduler of a cluster."""
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
    """Processes of this host in the place of this one: as nice, on the same CPUs. A pool that broke is replaced."""

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

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Hand a call to the next free process."""
        try:
            return self._pool.submit(fn, *args, **kwargs)
        except BrokenProcessPool:
            self._pool.shutdown(wait=False, cancel_futures=True)
            self._pool = self._new()
            return self._pool.submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Give up what waits; without `wait` the processes are ended, whatever they do."""
        processes = list((self._pool._processes or {}).values())
        self._pool.shutdown(wait=wait, cancel_futures=cancel_futures)
        if not wait:
            for process in processes:  # `kill_workers` of Python 3.14 may wait
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
    """A client of a cluster's scheduler. Raise ClusterUnavailableError."""
    import distributed  # noqa: PLC0415 - an extra, and slow to import

    new: Any = distributed.Client  # its module is typed in part
    logging.getLogger("distributed").setLevel(logging.WARNING)  # importing it has set another one
    try:
        return new(address, timeout=CONNECT_S, set_as_default=False, direct_to_workers=True, name=name)
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
