"""A scheduler and workers of a Dask cluster in real processes."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tests.service.data import DEADLINE, eventually
from tests.service.server import children, command, free_port
from tests.system.cluster.servers import Shared


class Workers:
    """A scheduler, and workers started by name, on the services' shared resources. module: the code that workers
    run."""

    def __init__(self, shared: Shared, folder: Path, module: str = "service") -> None:
        self.shared, self.folder, self.module = shared, folder, module
        self.port = free_port()
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.scheduler: subprocess.Popen[bytes] | None = None

    def start_scheduler(self) -> None:
        """Start a scheduler without state at the same address."""
        given = ["--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard"]
        self.scheduler = self._start("scheduler", ["-m", "distributed.cli.dask_scheduler", *given])
        eventually(lambda: "Scheduler at" in self.log("scheduler"))

    def start(self, name: str, *options: str, **settings: str) -> None:
        """Start a worker."""
        env = {**self.shared.env(), "LIPSERVE_CLUSTER": self.address, "LIPSERVE_HOME": str(self.shared.home(name))}
        self._start(name, ["-m", self.module, "worker", "--name", name, *options], {**env, **settings})

    def wait_until_joined(self, *names: str, times: int = 1) -> None:
        """Wait until workers have joined this many times."""
        for name in names:
            process = self.processes[name]
            eventually(lambda n=name, p=process: p.poll() is not None or self.log(n).count("has joined") >= times)
            assert process.poll() is None, self.log(name)

    def log(self, name: str) -> str:
        """Return the log of a process."""
        return (self.folder / f"{name}.log").read_text()

    def list_training_processes(self, name: str) -> list[int]:
        """Return the process ids of a worker's training processes."""
        return [pid for pid in children(self.processes[name].pid) if "spawn_main" in command(pid)]

    def kill(self, name: str) -> None:
        """Kill a process."""
        process = self.processes.pop(name)
        process.send_signal(signal.SIGKILL)
        process.wait(DEADLINE)

    def terminate(self, name: str) -> int:
        """Terminate a process; return its exit code."""
        process = self.processes.pop(name)
        process.terminate()
        return process.wait(DEADLINE)

    def close(self) -> None:
        """Kill all processes."""
        for name in list(self.processes):
            with suppress(ProcessLookupError):
                self.kill(name)

    def _start(self, name: str, arguments: list[str], env: dict[str, str] | None = None) -> subprocess.Popen[bytes]:
        with (self.folder / f"{name}.log").open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, *arguments],
                env={**os.environ, **(env or {})},
                stdout=log,
                stderr=log,
            )
        self.processes[name] = process
        return process


@contextmanager
def cluster(shared: Shared, folder: Path, *names: str, module: str = "service") -> Iterator[Workers]:
    """Start a scheduler with workers; stop them afterwards."""
    folder.mkdir(exist_ok=True)
    made = Workers(shared, folder, module)
    try:
        for name in names:  # they wait for the scheduler
            made.start(name)
        made.start_scheduler()
        made.wait_until_joined(*names)
        yield made
    finally:
        made.close()
