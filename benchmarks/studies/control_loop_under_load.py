"""A control loop of 1 kHz beside the worst that other clients do, with and without a data plane, and beside an echo.

    python benchmarks/studies/control_loop_under_load.py [--seconds 20] [--windows 2] [--spin 0] [--loads NAME ...]

Two services run, one with LIPSERVE_DATA_PLANE=on and one without. In turns, each gets all loads for a window, while a
stream of torques and a stream of echoes send a frame every millisecond. A third loop only wakes up each millisecond,
with a priority above that of the service: it shows how long the machine itself stands still. The threads of these
loops have SCHED_FIFO where that is permitted. --spin: processes that only compute, beside everything else.

Each latency counts from when its frame was due, so a late answer also counts at the frames that it delays. Frames that
a slow service has not reached at the end of the window count with their wait until then: nothing is left out. A second
table leaves out the frames that a stall of the machine has delayed, and states their share. An answer is wrong if it is
an error, or has another sequence or another torque than the first one.
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
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
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
from service.runtime.realtime import PRIORITY

PANDA = Path(__file__).parents[2] / "models" / "panda-sim"
PATHS = {"echo": "/v1/echo/stream", "torque": f"/v1/models/{MODEL}/stream?std=1&version=1"}
LOOPS = ("wake-up", *PATHS)
FRAME = np.array([[0.1, -0.1, 0.0, -1.8, 0.2, 1.6, 0.3], np.zeros(7), np.zeros(7)])
SPIN_S = 50e-6
"""The client sleeps until this time before a frame is due, then it polls the clock."""
WARM_UP_S, END_S = 1.0, 5.0
"""Start of a window that is not counted, and max wait for the end of the loads, s."""
SHARES = (50, 99, 99.9, 99.99, 100)
STALL_S = 1e-3
"""Delay of a wake-up from which on the machine stands still, s."""
WAKE_UP_PRIORITY, CLIENT_PRIORITY = 2 * PRIORITY, 2
"""Priorities of SCHED_FIFO: above and below the service."""


@dataclass
class Measured:
    """Due times and latencies of a loop, s, and the number of its wrong answers."""

    due: Array
    latencies: Array
    wrong: int
    real_time: bool

    def outside(self, wake_ups: Measured) -> Measured:
        """Return the frames that no stall of the machine has delayed, neither itself nor by the frames before."""
        late = wake_ups.latencies > STALL_S
        ends = np.sort((wake_ups.due + wake_ups.latencies)[late])
        starts = np.sort(wake_ups.due[late] - STALL_S)
        answered = self.due + self.latencies
        delayed = np.searchsorted(starts, answered) > np.searchsorted(ends, self.due)
        for index in np.flatnonzero(self.due[1:] < answered[:-1]) + 1:
            delayed[index] |= delayed[index - 1]
        return replace(self, due=self.due[~delayed], latencies=self.latencies[~delayed])


def run_loop(exchange: Callable[[int], bool], priority: int, rate: float, seconds: float) -> Measured:
    """Exchange frames on schedule, and measure each answer from when its frame was due.

    exchange: sends the frame of a number, and returns whether the answer is right.
    """
    real_time = False
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        real_time = True
    latencies, wrong = [], 0
    begin = time.perf_counter() + 0.05
    due, last, end = begin, 0.0, begin + seconds + WARM_UP_S
    while due < end and last < end:
        while (now := time.perf_counter()) < due:
            if due - now > 2 * SPIN_S:
                time.sleep(due - now - SPIN_S)
        wrong += not exchange(len(latencies))
        last = time.perf_counter()
        latencies.append(last - due)
        due = begin + len(latencies) / rate
    missed = np.arange(due, end, 1 / rate)  # the service fell behind
    latencies += (last - missed).tolist()
    counted = np.array(latencies[int(rate * WARM_UP_S) :])
    return Measured(begin + WARM_UP_S + np.arange(len(counted)) / rate, counted, wrong, real_time)


def run_stream(
    port: int, what: str, rate: float, seconds: float, out: multiprocessing.Queue[tuple[str, Measured]]
) -> None:
    """Run the loop of a stream, or of wake-ups without a service."""
    if what == "wake-up":
        out.put((what, run_loop(lambda _: True, WAKE_UP_PRIORITY, rate, seconds)))
        return
    stream, motion, first = WebSocket(("127.0.0.1", port), PATHS[what]), FRAME.tobytes(), b""

    def exchange(number: int) -> bool:
        nonlocal first
        sent = REQUEST.pack(number + 1, 0, 7, 0.0) + motion
        answer = stream.ask(frame(sent))
        if what == "echo":
            return answer == sent
        sequence, flags, *_ = ANSWER.unpack_from(answer)
        first = first or answer[ANSWER.size :]
        return sequence == number + 1 and not flags & ERROR and answer[ANSWER.size :] == first

    out.put((what, run_loop(exchange, CLIENT_PRIORITY, rate, seconds)))


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
    """Return the latencies of all loops during a window; print the number of other answers by status."""
    before = count_requests(bed)
    with loaded(bed, names):
        out: multiprocessing.Queue[tuple[str, Measured]] = multiprocessing.Queue()
        loops = [
            multiprocessing.Process(target=run_stream, args=(bed.tcp[1], what, rate, seconds, out)) for what in LOOPS
        ]
        for each in loops:
            each.start()
        measured = dict(out.get(timeout=seconds + TIMEOUT) for _ in LOOPS)
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


def report(name: str, what: str, windows: list[Measured], number: int | None = None) -> None:
    """Print percentiles of all windows together. number: of the frames of which these are a part."""
    latencies = 1e3 * np.concatenate([each.latencies for each in windows])
    if not len(latencies):
        print(f"{name:14} {what:7} no frame")
        return
    figures = zip(("p50", "p99", "p99.9", "p99.99", "max"), np.percentile(latencies, SHARES), strict=True)
    texts = [f"{figure} {value:8.3f}" for figure, value in figures]
    wrong = sum(each.wrong for each in windows)
    end = f"({'SCHED_FIFO' if windows[0].real_time else 'normal priority'})"
    if number is not None:
        end = f"({100 * len(latencies) / number:.2f} % of the frames)"
    print(f"{name:14} {what:7} {len(latencies):7} frames, ms: {'  '.join(texts)}  wrong {wrong}  {end}", flush=True)


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
        for what in LOOPS:
            report(f"data plane {each}", what, [window[what] for window in results[each]])
    print("without frames that a stall of the machine has delayed:")
    for each in given.planes:
        for what in PATHS:
            windows = [window[what].outside(window["wake-up"]) for window in results[each]]
            report(f"data plane {each}", what, windows, sum(len(window[what].due) for window in results[each]))


def _settings(plane: str) -> dict[str, str]:
    return {"data_plane": plane, "log_level": "error", "promotion": "always"}


if __name__ == "__main__":
    sys.exit(main())
