"""Round trip of the C++ and the Python client at 1 kHz, and a C++ client while the service is killed and restarted.

    python benchmarks/studies/cpp_client.py [COMPILER]

The service runs on this machine with the shipped Panda. Round trips are measured in turn for ten seconds, three times.
Then a client with sanitizers sends queries with measured torque for a minute; queries, answers, acknowledgements and
the rows in the service's log are counted.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import undefer

from lipcore.robots.library import load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipserve import StreamClient
from service.foundation.settings import Settings
from service.journal import log
from service.storage.database import Database, EventRow

CPP = Path(__file__).parents[2] / "clients/cpp"
PORT, MODEL, STREAM = 18_431, "panda-sim", "minute"
PERIOD_S, TRIALS, TICKS = 0.001, 3, 10_000
CYCLES, BUDGET_US = 60_000, 900
SANITIZED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@contextmanager
def service(home: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start a service and wait until it is ready; kill it at the end."""
    environment = {**os.environ, "LIPSERVE_HOME": str(home / "home"), "LIPSERVE_UDS": str(home / "socket")}
    with (home / "log").open("ab") as file:
        command = [sys.executable, "-m", "service", "serve", "--port", str(PORT)]
        process = subprocess.Popen(command, env=environment, stdout=file, stderr=file)  # noqa: S603
    try:
        while not ready():
            time.sleep(0.1)
        yield process
    finally:
        process.kill()
        process.wait()


def ready() -> bool:
    """Return whether the service answers."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{PORT}/health/ready", timeout=1) as answer:
            return bool(answer.status == 200)
    except OSError:
        return False


def compiled(compiler: str, folder: Path, *options: str) -> Path:
    """Compile the program that drives a client; return its path."""
    program = folder / f"drive{len(options)}"
    command = [compiler, "-std=c++17", *options, f"-I{CPP / 'include'}", str(CPP / "tests/drive.cpp"), "-o", program]
    subprocess.run(command, check=True)  # noqa: S603
    return program


class Driver:
    """A C++ client that reads commands from standard input."""

    def __init__(self, program: Path, folder: Path, *options: str) -> None:
        arguments = [f"model={MODEL}", "joints=7", f"rows={folder / 'rows'}", *options]
        self.process = subprocess.Popen(  # noqa: S603
            [program, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def begin(self, line: str) -> None:
        """Send a command."""
        assert self.process.stdin is not None
        print(line, file=self.process.stdin, flush=True)

    def until(self, start: str) -> str:
        """Return the next line that starts with `start`."""
        assert self.process.stdout is not None
        while not (line := self.process.stdout.readline()).startswith(start):
            assert line, "the client has ended"
        return line

    def do(self, line: str) -> dict[str, float]:
        """Send a command and return its report."""
        self.begin(line)
        report: dict[str, float] = json.loads(self.until("{"))
        assert report["allocations"] == 0
        return report

    def end(self) -> int:
        """Stop the client; return its exit code, which is not 0 if a sanitizer found an error."""
        self.process.communicate("end\n")
        return self.process.returncode


def cpp_round_trip(program: Path, folder: Path, url: str) -> tuple[float, float]:
    """Return p50 and p99 of a C++ client's round trip, µs."""
    client = Driver(program, folder, f"url={url}")
    client.do("connect 10")
    report = client.do(f"loop-ask {TICKS} {PERIOD_S * 1e6:.0f} 1000000 0")
    client.end()
    return report["p50_us"], report["p99_us"]


def python_round_trip(motions: np.ndarray, **address: object) -> tuple[float, float]:
    """Return p50 and p99 of the Python client's round trip, µs."""
    trips, due = [], time.perf_counter()
    with StreamClient(MODEL, **address) as client:  # type: ignore[arg-type]
        for tick in range(TICKS):
            q, dq, ddq = motions[tick % len(motions), :3]
            began = time.perf_counter()
            client.predict(q, dq, ddq)
            trips.append(1e6 * (time.perf_counter() - began))
            due += PERIOD_S
            time.sleep(max(0.0, due - time.perf_counter()))
    return float(np.quantile(trips, 0.5)), float(np.quantile(trips, 0.99))


def round_trips(program: Path, folder: Path, motions: np.ndarray) -> None:
    """Print the round trips of both clients over both sockets."""
    url, socket = f"http://127.0.0.1:{PORT}", folder / "socket"
    subjects = {
        "C++, TCP": lambda: cpp_round_trip(program, folder, url),
        "Python, TCP": lambda: python_round_trip(motions, url=url),
        "C++, Unix socket": lambda: cpp_round_trip(program, folder, f"unix://{socket}"),
        "Python, Unix socket": lambda: python_round_trip(motions, unix=socket),
    }
    with service(folder):
        seen = [{name: measure() for name, measure in subjects.items()} for _ in range(TRIALS)]
    print("| client | p50, µs | p99, µs |\n| --- | --- | --- |")
    for name in subjects:
        p50, p99 = np.median([trial[name] for trial in seen], axis=0)
        print(f"| {name} | {p50:.0f} | {p99:.0f} |")


def minute(program: Path, folder: Path, expected: np.ndarray) -> None:
    """Print the counts of a minute at 1 kHz in which the service is killed."""
    with service(folder) as first:
        client = Driver(program, folder, f"url=http://127.0.0.1:{PORT}", f"stream_id={STREAM}")
        client.do("connect 10")
        client.begin(f"loop {CYCLES} {PERIOD_S * 1e6:.0f} {BUDGET_US} 0")
        client.until("cycle")
        first.kill()
        first.wait()
        began = time.monotonic()
    with service(folder):
        down = time.monotonic() - began
        report = json.loads(client.until("{"))
        flushed = client.do("flush 60")
        code = client.end()
        found = logged(folder / "home")
    asked = {name: report.get(f"ask_{name}", 0) for name in ("ok", "timeout", "unreachable")}
    unique = {row.tobytes() for row in found}
    print(f"\nkilled and ready again after {down:.1f} s; compiled with {' '.join(SANITIZED)}")
    print(f"queries {CYCLES}: {asked}, p50 {report['p50_us']:.0f} µs, p99 {report['p99_us']:.0f} µs")
    print(f"rows sent {flushed['taught']}, sent again {flushed['resent']}, connections {flushed['connections']}")
    acknowledged = {name: flushed[name] for name in ("accepted", "duplicates", "rejected", "refused", "unsettled")}
    print(f"acknowledged {sum(list(acknowledged.values())[:3])}: {acknowledged}")
    print(f"in the log {len(found)}, lost {len(expected) - len(unique)}, twice {len(found) - len(unique)}, "
          f"in order: {len(found) == len(expected) and bool((found == expected).all())}")  # fmt: skip
    print(f"allocations in the loop {report['allocations']}, exit code under sanitizers {code}")


def logged(home: Path) -> np.ndarray:
    """Return the rows of the stream in the service's log, (N, 4, 7)."""
    database = Database.of(Settings(home=home))
    with database.session() as session:
        query = select(EventRow).where(EventRow.stream_id == STREAM, EventRow.kind == "batch")
        events = session.scalars(query.order_by(EventRow.number).options(undefer(EventRow.payload)))
        rows = [log.decode(event.payload) for event in events]
    database.close()
    return np.concatenate([np.stack([each.q, each.dq, each.ddq, each.tau], 1) for each in rows])


def main() -> None:
    """Compile, measure, print."""
    compiler = sys.argv[1] if len(sys.argv) > 1 else "g++"
    arm = simulate(load_robot("panda"), Simulation(n_samples=CYCLES, rate=1 / PERIOD_S), seed=4)
    rows = np.stack([arm.q, arm.dq, arm.ddq, arm.tau], 1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "rows").write_bytes(rows.astype("<f8").tobytes())
        round_trips(compiled(compiler, folder, "-O2"), folder, rows)
        minute(compiled(compiler, folder, *SANITIZED), folder, rows)


if __name__ == "__main__":
    main()
