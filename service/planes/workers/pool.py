"""The workers of the control plane: started with the first task, ended after a while without one."""

from __future__ import annotations

import asyncio
import itertools
import logging
import os
import socket
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import CancelledError
from contextlib import suppress
from typing import Any, Protocol, TypeVar
from weakref import WeakValueDictionary

from anyio import CapacityLimiter, to_thread

from lipcore.model.torque_model import TorqueModel
from service.api.elsewhere import NoWorkerError
from service.foundation.errors import NotReadyError
from service.foundation.settings import Settings
from service.models.served import ServedModel
from service.planes.workers.arena import Arena
from service.planes.workers.messages import Arenas, Done, NewModel, Packed, Task, VersionState
from service.planes.workers.process import serve
from service.runtime.channel import Channel
from service.runtime.process import SERVING_THREADS, ProcessOptions
from service.telemetry import logs

logger = logging.getLogger(__name__)
T = TypeVar("T")

IDLE_S = 60.0
"""Time without a task after which a worker ends, s."""
NICENESS = 5
"""Niceness of workers: between that of the service and that of training."""
MAX_MODELS = 4
"""Max models that a worker keeps; a comparison needs up to four."""
ATTEMPTS = 2
"""Max times that a task is computed if its worker is lost."""


class Process(Protocol):
    """A forked process."""

    pid: int

    def is_alive(self) -> bool:
        """Return whether it runs."""

    def kill(self) -> None:
        """Kill it."""


Fork = Callable[..., Process]
"""Forks a process, as `Nursery.start` does."""


LOST = (
    f"The process that computes the answer has ended {ATTEMPTS} times: the system may be out of memory. "
    "Send a smaller batch, or retry later."
)


class WorkerLostError(Exception):
    """The worker has ended before it answered."""


class Worker:
    """The control plane's end of a worker. One thread uses it at a time; any may kill it."""

    def __init__(self, settings: Settings, fork: Fork) -> None:
        """Start a process; raise OSError."""
        options = ProcessOptions(SERVING_THREADS, niceness=NICENESS, log=logs.current_options())
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self.process = fork("worker", options, theirs, serve, options, settings)
        self.used = 0.0
        self._channel, self._given, self._results = Channel(ours), Arena(), Arena()
        self._known: OrderedDict[int, None] = OrderedDict()
        self._channel.send(Arenas(), [self._given.handle, self._results.handle])

    def compute(
        self,
        function: Callable[..., Any],
        served: ServedModel | tuple[ServedModel, ...],
        given: tuple[Any, ...],
        number: Callable[[TorqueModel], int],
    ) -> Any:
        """Compute a task; raise its error, or WorkerLostError."""
        models: dict[int, TorqueModel] = {}

        def numbered(model: TorqueModel) -> int:
            models[number(model)] = model
            return number(model)

        if isinstance(served, tuple):
            versions: Any = tuple(VersionState.of(each, numbered) for each in served)
        else:
            versions = VersionState.of(served, numbered)
        for key, model in models.items():
            if key not in self._known and not self._send_model(key, model):
                raise WorkerLostError
            self._known[key] = None
            self._known.move_to_end(key)
        dropped = tuple(self._known.popitem(last=False)[0] for _ in range(len(self._known) - MAX_MODELS))
        task = Task(function, versions, Packed.of(given, self._given), dropped)
        if not self._channel.send(task) or (received := self._channel.receive()) is None:
            raise WorkerLostError
        answer = received[0]
        if isinstance(answer, Done):
            return answer.result.read(self._results.read(answer.result.spans))
        raise answer.error

    def _send_model(self, number: int, model: TorqueModel) -> bool:
        with suppress(RuntimeError):  # another thread has cached a property meanwhile
            return self._channel.send(NewModel(number, model))
        return self._channel.send(NewModel(number, model))

    def kill(self) -> None:
        """Kill the process."""
        self.process.kill()

    def close(self) -> None:
        """Close the connection, which ends the process once it has no task, and free its memory."""
        self._channel.close()
        self._given.close()
        self._results.close()


class Running:
    """A task in work, which another thread may cancel."""

    def __init__(self) -> None:
        self.cancelled = False
        self._lock = threading.Lock()
        self._worker: Worker | None = None

    def begin(self, worker: Worker) -> bool:
        """Note the worker of the task; return False if the task was cancelled."""
        with self._lock:
            self._worker = worker
            return not self.cancelled

    def end(self) -> None:
        """Note that no worker computes it any more."""
        with self._lock:
            self._worker = None

    def cancel(self) -> None:
        """Kill the worker that computes it; if there is none yet, it does not begin."""
        with self._lock:
            self.cancelled = True
            if self._worker is not None:
                self._worker.kill()


class WorkerPool:
    """Niced processes that compute tasks.

    Args:
        settings: Settings of the service.
        fork: Forks a process with the imports of the service.
        clock: Time in s.
    """

    def __init__(self, settings: Settings, fork: Fork, clock: Callable[[], float] = time.monotonic) -> None:
        self._settings, self._fork, self._clock = settings, fork, clock
        self._lock, self._idle = threading.Lock(), list[Worker]()
        self._turns: CapacityLimiter | None = None
        self._check: asyncio.TimerHandle | None = None
        self._models: WeakValueDictionary[int, TorqueModel] = WeakValueDictionary()
        self._numbers: dict[int, int] = {}
        self._next = itertools.count(1)

    async def run(self, function: Callable[..., T], served: Any, *given: Any) -> T:
        """Return `function(storage, served, *given)`, computed by a worker with a storage of its own.

        A cancelled task does not begin, or its worker is killed. Raise the errors of the function, NoWorkerError, or
        NotReadyError if workers were lost repeatedly.
        """
        if self._turns is None:
            self._turns = CapacityLimiter(min(self._settings.max_concurrent_predictions, os.cpu_count() or 1))
        running = Running()
        try:
            return await to_thread.run_sync(
                self._compute, running, function, served, given, limiter=self._turns, abandon_on_cancel=True
            )
        except asyncio.CancelledError:
            running.cancel()
            raise
        finally:
            if self._check is None:
                self._check = asyncio.get_running_loop().call_later(IDLE_S, self._end_idle_again)

    def end_idle(self) -> int:
        """End the workers without a task for `IDLE_S`; return how many remain without one."""
        with self._lock:
            until = self._clock() - IDLE_S
            ended = [each for each in self._idle if each.used <= until or not each.process.is_alive()]
            self._idle = [each for each in self._idle if each not in ended]
        for each in ended:
            each.close()
        return len(self._idle)

    def close(self) -> None:
        """End all workers without a task."""
        with self._lock:
            ended, self._idle = self._idle, []
        for each in ended:
            each.close()

    def _end_idle_again(self) -> None:
        self._check = None
        if self.end_idle():
            self._check = asyncio.get_running_loop().call_later(IDLE_S / 4, self._end_idle_again)

    def _compute(self, running: Running, function: Callable[..., T], served: Any, given: tuple[Any, ...]) -> T:
        for attempt in range(ATTEMPTS):
            try:
                worker = self._take() if attempt == 0 else self._start()
            except OSError as error:
                logger.error("no worker can be started: %s", error)
                raise NoWorkerError from error
            try:
                if not running.begin(worker):
                    raise CancelledError
                result: T = worker.compute(function, served, given, self._number)
            except WorkerLostError:
                running.end()
                worker.kill()
                worker.close()
                if running.cancelled:
                    raise CancelledError from None
                logger.error("worker %d has ended during a task", worker.process.pid)
            except BaseException:
                self._give_back(running, worker)
                raise
            else:
                self._give_back(running, worker)
                return result
        raise NotReadyError(LOST, headers={"Retry-After": "10"})

    def _take(self) -> Worker:
        while True:
            with self._lock:
                worker = self._idle.pop() if self._idle else None
            if worker is None:
                return self._start()
            if worker.process.is_alive():
                return worker
            worker.close()

    def _start(self) -> Worker:
        return Worker(self._settings, self._fork)

    def _give_back(self, running: Running, worker: Worker) -> None:
        running.end()
        worker.used = self._clock()
        with self._lock:
            self._idle.append(worker)

    def _number(self, model: TorqueModel) -> int:
        """Return the number of a model, the same for the same object."""
        with self._lock:
            number = self._numbers.get(id(model), 0)
            if self._models.get(number) is not model:  # another one had this place in memory
                number = next(self._next)
                self._models[number] = model
                self._numbers[id(model)] = number
                self._numbers = {key: each for key, each in self._numbers.items() if each in self._models}
            return number
