"""A control loop of 1 kHz beside the worst that other clients do, with and without a data plane, and beside an echo.

    python benchmarks/studies/control_loop_under_load.py [--seconds 20] [--windows 2] [--spin 0] [--loads NAME ...]

Two services run, one with LIPSERVE_DATA_PLANE=on and one without. In turns, each gets all loads for a window, while a
stream of torques and a stream of echoes send a frame every millisecond. The threads of these clients have SCHED_FIFO
where that is permitted. --spin: processes that only compute, beside everything else.

A late answer delays the frames after it, and their latency counts from when they were due. Those that a slow service
has not reached at the end of the window count with their wait until then: nothing is left out. An answer is wrong if it
is an error, or has another sequence or another torque than the first one.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np

from benchmarks.clients import TIMEOUT
from benchmarks.latency.websocket import WebSocket, frame
from benchmarks.online.bed import Bed, install, serving
from benchmarks.studies.worst_loads import ARM, LOADS, MODEL, prepare
from lipcore.data.samples import Array
from lipserve.frames import ANSWER, ERROR, REQUEST
from service.contract.observations import LearningOptions

PANDA = Path(__file__).parents[2] / "models" / "panda-sim"
FRAME = np.array([[0.1, -0.1, 0.0, -1.8, 0.2, 1.6, 0.3], np.zeros(7), np.zeros(7)])
SPIN_S = 50e-6
"""The client sleeps until this time before a frame is due, then it polls the clock."""
WARM_UP_S, END_S = 1.0, 5.0
"""Start of a window that is not counted, and max wait for the end of the loads, s."""
SHARES = (50, 99, 99.9, 99.99, 100)


@dataclass
class Measured:
    """Latencies of a stream, s, and the number of its wrong answers."""

    latencies: Array
    wrong: int
    real_time: bool


def run_loop(
    port: int, path: str, rate: float, seconds: float, echoes: bool, out: multiprocessing.Queue[Measured]
) -> None:
    """Send frames on schedule, and measure each answer from when its frame was due."""
    real_time = False
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(2))
        real_time = True
    stream, motion = WebSocket(("127.0.0.1", port), path), FRAME.tobytes()
    latencies, wrong, first = [], 0, b""
    due = time.perf_counter() + 0.05
    end = due + seconds + WARM_UP_S
    sequence, last = 0, 0.0
    while due < end and last < end:
        now, behind = time.perf_counter(), last > due
        while now < due:
            if due - now > 2 * SPIN_S:
                time.sleep(due - now - SPIN_S)
            now = time.perf_counter()
        sequence += 1
        sent = REQUEST.pack(sequence, 0, 7, 0.0) + motion
        answer = stream.ask(frame(sent))
        last = time.perf_counter()
        latencies.append(last - (due if behind else now))
        if echoes:
            wrong += answer != sent
        else:
            number, flags, *_ = ANSWER.unpack_from(answer)
            first = first or answer[ANSWER.size :]
            wrong += number != sequence or bool(flags & ERROR) or answer[ANSWER.size :] != first
        due += 1 / rate
    missed = np.arange(due, end, 1 / rate)  # the service fell behind
    latencies += (last - missed).tolist()
    out.put(Measured(np.array(latencies[int(rate * WARM_UP_S) :]), wrong, real_time))


@contextmanager
def loaded(bed: Bed, names: list[str]) -> Iterator[None]:
    """Run loads of a service, each in a process of a low priority."""
    ending = multiprocessing.Event()
    processes = [multiprocessing.Process(target=_load, args=(name, bed.tcp[1], ending), daemon=True) for name in names]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        ending.set()
        deadline = time.monotonic() + END_S
        for process in processes:
            process.join(max(0.0, deadline - time.monotonic()))
            if process.is_alive():
                process.kill()


def _load(name: str, port: int, ending: Event) -> None:
    os.nice(10)
    LOADS[name](port, ending)


def _spin() -> None:
    while True:
        pass


def measure(bed: Bed, names: list[str], rate: float, seconds: float) -> dict[str, Measured]:
    """Return the latencies of both streams during a window; print what the loads have got meanwhile."""
    paths = {"torque": f"/v1/models/{MODEL}/stream?std=1&version=1", "echo": "/v1/echo/stream"}
    before = count_requests(bed)
    with loaded(bed, names):
        out = {what: multiprocessing.Queue() for what in paths}
        loops = [
            multiprocessing.Process(target=run_loop, args=(bed.tcp[1], path, rate, seconds, what == "echo", out[what]))
            for what, path in paths.items()
        ]
        for each in loops:
            each.start()
        measured = {what: results.get(timeout=seconds + TIMEOUT) for what, results in out.items()}
    answers = count_requests(bed) - before
    texts = (f"{number} {status}" for status, number in sorted(answers.items()))
    print(f"  other requests by status: {', '.join(texts)}", file=sys.stderr)
    return measured


def count_requests(bed: Bed) -> Counter[str]:
    """Return the number of answered requests by status."""
    found: Counter[str] = Counter()
    for status, number in re.findall(r'^lipserve_requests_total{.*status="(\d+)".*} (\d+)', bed.client.metrics(), re.M):
        found[status] += int(number)
    return found


def report(name: str, what: str, windows: list[Measured]) -> None:
    """Print percentiles of all windows together."""
    latencies = 1e3 * np.concatenate([each.latencies for each in windows])
    figures = zip(("p50", "p99", "p99.9", "p99.99", "max"), np.percentile(latencies, SHARES), strict=True)
    texts = [f"{figure} {value:8.3f}" for figure, value in figures]
    wrong = sum(each.wrong for each in windows)
    policy = "SCHED_FIFO" if windows[0].real_time else "normal priority"
    print(
        f"{name:14} {what:7} {len(latencies):7} frames, ms: {'  '.join(texts)}  wrong {wrong}  ({policy})", flush=True
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="length of a window")
    parser.add_argument("--windows", type=int, default=2, help="windows of each service")
    parser.add_argument("--rate", type=float, default=1000.0, help="frames per second")
    parser.add_argument("--spin", type=int, default=0, help="processes that only compute")
    parser.add_argument("--loads", nargs="*", default=list(LOADS), choices=list(LOADS), help="loads; none: no load")
    parser.add_argument("--planes", nargs="*", default=["on", "off"], choices=["on", "off"])
    given = parser.parse_args()
    multiprocessing.set_start_method("fork")
    spinning = [multiprocessing.Process(target=_spin, daemon=True) for _ in range(given.spin)]
    with tempfile.TemporaryDirectory() as folder:
        results: dict[str, list[dict[str, Measured]]] = {}
        homes = {each: Path(folder) / each for each in given.planes}
        first, *others = homes.values()
        install(first, PANDA, {ARM: LearningOptions()}, 7)
        with serving(first, _settings(given.planes[0])) as bed:
            prepare(bed.client)
        for home in others:
            shutil.copytree(first, home)
        for process in spinning:
            process.start()
        for number in range(given.windows):
            for each in given.planes if number % 2 == 0 else reversed(given.planes):
                print(f"window {number + 1} with data plane {each}", file=sys.stderr)
                with serving(homes[each], _settings(each)) as bed:
                    results.setdefault(each, []).append(measure(bed, given.loads, given.rate, given.seconds))
    print(f"model {MODEL}, learning {ARM}, loads: {', '.join(given.loads) or 'none'}, {given.spin} busy processes")
    for each in given.planes:
        for what in ("echo", "torque"):
            report(f"data plane {each}", what, [window[what] for window in results[each]])


def _settings(plane: str) -> dict[str, str]:
    return {"data_plane": plane, "log_level": "error", "promotion": "always"}


if __name__ == "__main__":
    sys.exit(main())
