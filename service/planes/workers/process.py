"""The process of a worker: it computes one task after another until the control plane closes the connection."""

from __future__ import annotations

import gc
import logging
import os
import pickle
import socket
import traceback
from functools import cached_property
from multiprocessing.connection import Connection
from typing import Any

from threadpoolctl import threadpool_limits

from lipcore.model.torque_model import TorqueModel
from lipcore.posterior.threads import limit_threads
from service.foundation.settings import Settings
from service.models.served import ServedModel
from service.planes.workers.arena import Arena
from service.planes.workers.messages import Arenas, Done, Failed, NewModel, Packed, Task, VersionState
from service.runtime.channel import Channel
from service.runtime.process import SERVING_THREADS, ProcessOptions, start_process
from service.storage.storage import Storage

logger = logging.getLogger(__name__)


def serve(options: ProcessOptions, settings: Settings, connection: Connection) -> None:
    """Compute tasks. It is the function of a forked process."""
    start_process(options)
    # as in the control plane: BLAS rounds differently with another number of threads
    threadpool_limits(SERVING_THREADS)
    limit_threads(SERVING_THREADS)
    gc.freeze()
    channel = Channel(socket.socket(fileno=os.dup(connection.fileno())))
    connection.close()
    worker = Worker(settings)
    while (received := channel.receive()) is not None:
        answer = worker.handle(*received)
        if answer is not None and not channel.send(answer):
            return


class Worker:
    """Models, versions and storage of the process."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._models: dict[int, TorqueModel] = {}
        self._versions: dict[tuple[str, int, int], ServedModel] = {}
        self._arenas: list[Arena] = []

    @cached_property
    def _storage(self) -> Storage:
        return Storage.open(self._settings)

    def handle(self, message: Any, handles: list[int]) -> Done | Failed | None:
        """Handle a message; return the answer if it was a task."""
        match message:
            case Arenas():
                self._arenas = [Arena(each) for each in handles]
            case NewModel(number, model):
                self._models[number] = model
            case Task():
                return self._compute(message)
        return None

    def _compute(self, task: Task) -> Done | Failed:
        given, results = self._arenas
        for number in task.dropped:
            del self._models[number]
        self._versions = {key: each for key, each in self._versions.items() if key[2] in self._models}
        try:
            found = task.versions
            versions = tuple(map(self._version, found)) if isinstance(found, tuple) else self._version(found)
            arguments = task.given.read(given.view(task.given.spans))
            return Done(Packed.of(task.function(self._storage, versions, *arguments), results))
        except Exception as error:
            return Failed(_sendable(error))

    def _version(self, state: VersionState) -> ServedModel:
        """Return a version, the same object as long as its model is the same: it keeps models of declared payloads."""
        key = state.name, state.version, state.model
        known = self._versions.get(key)
        if known is None:
            known = self._versions[key] = state.served(self._models)
        else:
            state.update(known, self._models)
        return known


def _sendable(error: Exception) -> Exception:
    """Return an error that another process can raise."""
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301 - of this process
        return error
    except Exception:
        logger.exception("an error of a worker cannot be sent")
        return RuntimeError("".join(traceback.format_exception_only(error)).strip())
