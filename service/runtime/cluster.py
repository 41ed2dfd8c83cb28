"""The connection of a service to the scheduler of its cluster; a thread restores it after each loss."""

from __future__ import annotations

import logging
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

from service.runtime.executors import ClusterUnavailableError, connect

logger = logging.getLogger(__name__)

CHECK_S = 2.0
"""Seconds between two checks of the scheduler."""
JOB, GPU = "JOB", "GPU"
"""Tags of workers that run jobs, and of those that have a GPU."""


def needs_gpu(request: dict[str, Any]) -> bool:
    """Return whether a job needs a worker with a GPU, from its request."""
    return bool(request.get("options", {}).get("device") == "cuda")


class Cluster:
    """The cluster of one service. All methods but `close` return at once, even if the scheduler does not answer.

    problem: why the cluster cannot be used now, None if it can. jobs, gpus: number of jobs that its workers run at a
    time, and of those with a GPU, at the last count.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        self.problem: str | None = f"the scheduler {address} has not answered yet"
        self.jobs = self.gpus = 0
        self._client: Any = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name="cluster")
        self._thread.start()

    def submit(self, key: str, gpu: bool, function: Callable[..., Any], *given: Any) -> Any:
        """Call a function on a worker that runs jobs; return a future of the cluster.

        The call continues if this service ends. Raise ClusterUnavailableError.
        """
        client = self._client
        if self.problem is not None or client is None:
            raise ClusterUnavailableError(self.problem or "not connected")
        import distributed  # noqa: PLC0415 - an extra

        keep: Any = distributed.fire_and_forget  # its module is only partly typed
        resources = {JOB: 1, GPU: 1} if gpu else {JOB: 1}
        try:
            future = client.submit(function, *given, key=key, resources=resources, pure=False)
            keep(future)
        except Exception as error:  # a connection that was just lost raises many kinds of errors
            raise ClusterUnavailableError(f"the scheduler {self.address} cannot be used: {error}") from None
        return future

    def knows(self, future: Any) -> bool:
        """Return whether the scheduler still has the call."""
        return future.client is self._client and not future.done()

    def drop(self, future: Any) -> None:
        """Withdraw a call that is no longer needed, if it has not started."""
        if self.knows(future):  # in a thread: it waits for the scheduler
            threading.Thread(target=_cancel, args=(future,), daemon=True).start()

    def close(self) -> None:
        """Leave the cluster; submitted calls continue."""
        self._closing.set()
        self._thread.join()
        self._leave()

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                self._refresh()
                self.problem = None
            except Exception as error:
                reason = str(error) or type(error).__name__
                if self.problem != reason:
                    logger.warning("the cluster cannot be used: %s", reason)
                self.problem, self.jobs, self.gpus = reason, 0, 0
            self._closing.wait(CHECK_S)

    def _refresh(self) -> None:
        if self._client is not None and self._client.status not in ("running", "connecting"):
            self._leave()
        if self._client is None:
            self._reach()
            self._client = connect(self.address)
        if self._client.status != "running":
            raise ClusterUnavailableError(f"the scheduler {self.address} of the cluster does not answer")
        workers = self._client.scheduler_info()["workers"].values()
        takes = [each["resources"] for each in workers if each["resources"].get(JOB)]
        self.jobs = round(sum(each[JOB] for each in takes))
        self.gpus = sum(bool(each.get(GPU)) for each in takes)

    def _reach(self) -> None:
        """Raise an error if nothing listens at the address; without this check, a client retries and logs for long."""
        parts = urlsplit(self.address)
        try:
            socket.create_connection((parts.hostname or "", parts.port or 8786), CHECK_S).close()
        except OSError as error:
            raise ClusterUnavailableError(
                f"the scheduler {self.address} of the cluster cannot be reached: {error.strerror or error}"
            ) from None

    def _leave(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            with suppress(Exception):  # the connection may be closed already
                client.close(timeout=1.0)


def _cancel(future: Any) -> None:
    with suppress(Exception):  # a worker then finds that there is nothing to do
        future.cancel(force=True)
