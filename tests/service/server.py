"""A service in a process of its own, to be killed and started again."""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx

from tests.service import backend
from tests.service.data import DEADLINE, eventually
from tests.service.warm import Served

COMPANIONS = ("lip-learner", "lip-weigher")
"""Names of processes that are forked, not spawned."""


class Server:
    """`lipserve serve` on a home; settings are environment variables.

    warm: fork it from a process with its imports, for shared services only; port: a free one if None; log: file for its
    output, beside the home if None; constants: of a warm one, by module and name; module: that a cold one runs.
    """

    patience = DEADLINE
    """Maximum time to start, in seconds."""

    def __init__(
        self,
        home: Path,
        warm: bool = False,
        port: int | None = None,
        log: Path | None = None,
        constants: Mapping[str, Any] | None = None,
        module: str = "service",
        **settings: str,
    ) -> None:
        self.module = module
        self.home, self.log = home, home.with_name(home.name + ".log") if log is None else log
        self.port = free_port() if port is None else port
        self.url = f"http://127.0.0.1:{self.port}"
        self.client = httpx.Client(base_url=self.url, timeout=DEADLINE)
        arguments = ["serve", "--port", str(self.port)]
        given = {"LIPSERVE_HOME": str(home), "LIPSERVE_PROMOTION": "always", **settings}
        environment = {**os.environ, **backend.environment(home), **given}
        self.process = (
            Served(arguments, environment, self.log, constants) if warm else self._spawned(arguments, environment)
        )
        try:
            eventually(self._ready, self.patience)
        except BaseException:
            self.kill()
            raise

    def _spawned(self, arguments: list[str], environment: dict[str, str]) -> subprocess.Popen[bytes]:
        with self.log.open("ab") as log:
            command = [sys.executable, "-m", self.module, *arguments]
            return subprocess.Popen(command, env=environment, stdout=log, stderr=log)

    def _ready(self) -> bool:
        assert self.process.poll() is None, self.log.read_text()
        try:
            return self.client.get("/health/ready").status_code == httpx.codes.OK
        except httpx.TransportError:
            return False

    def workers(self) -> list[int]:
        """Return process ids of training and learning, if settings give them a lower priority than serving."""
        own = os.getpriority(os.PRIO_PROCESS, self.process.pid)
        return [pid for pid in self.started() if os.getpriority(os.PRIO_PROCESS, pid) > own]

    def started(self) -> list[int]:
        """Return process ids of all of training, learning, and the one that estimates payloads."""
        return [pid for pid in descendants(self.process.pid) if "spawn_main" in command(pid) or name(pid) in COMPANIONS]

    def named(self, wanted: str) -> list[int]:
        """Return process ids of the processes with a name, such as `lip-data`."""
        return [pid for pid in descendants(self.process.pid) if name(pid) == wanted]

    def kill(self) -> None:
        """Kill it as a power cut would, with its children."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(DEADLINE)

    def terminate(self) -> int:
        """Send SIGTERM; return the exit code."""
        self.process.terminate()
        return self.process.wait(DEADLINE)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.client.close()
        if self.process.poll() is None:
            self.kill()


def free_port() -> int:
    """Return a free port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def command(pid: int) -> str:
    """Return the command line of a process, empty if it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")
    except (FileNotFoundError, ProcessLookupError):
        return ""


def name(pid: int) -> str:
    """Return the name of a process, empty if it has ended."""
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except (FileNotFoundError, ProcessLookupError):
        return ""


def state(pid: int) -> str:
    """Return the state of a process, such as R, S, T (stopped) or Z (zombie); empty if it has ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return ""


def is_running(pid: int) -> bool:
    """Return whether a process exists, other than as a zombie."""
    return state(pid) not in ("", "Z")


def descendants(pid: int) -> list[int]:
    """Return the process ids of the children of a process, and of their descendants."""
    return [each for child in children(pid) for each in (child, *descendants(child))]


def children(pid: int) -> list[int]:
    """Return the process ids of the children of a process."""
    found = []
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            lines = status.read_text().splitlines()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if f"PPid:\t{pid}" in lines:
            found.append(int(status.parent.name))
    return found
