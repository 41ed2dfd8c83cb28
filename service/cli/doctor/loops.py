"""Measured loops: how late a thread wakes up, and how late the answers of a service arrive.

A loop follows a schedule without drift. Each delay counts from the time when its tick was due, so that a stall counts
at every tick that it delays. A loop sleeps until its tick, because a thread that reads the clock instead would disturb
the service.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import count
from typing import Literal
from urllib.parse import urlsplit, urlunsplit

import numpy as np
from numpy.typing import NDArray
from websockets.exceptions import ConnectionClosed

from lipcore.data.samples import Array
from lipserve import StreamClient
from lipserve.exchange import closed, unanswered
from service.runtime.realtime import enter_real_time

RATES_HZ = (100, 250, 500, 1000)
IN_TIME_SHARE = 0.999
"""Share of the ticks that must be in time at a rate that the machine holds."""
WAKE_UP_PERIODS, ANSWER_PERIODS = 0.5, 1.0
"""Periods from which on a wake-up and an answer are late. A wake-up leaves half of the period to the answer."""
MAX_STRETCH = 2.0
"""A loop that falls behind ends after this multiple of its time; the ticks that are left count as late."""
WARM_UP = 20
"""Queries before a measured loop."""
ECHO_PATH = "/v1/echo/stream"

Policy = Literal["plain", "SCHED_FIFO"]
Nanoseconds = NDArray[np.int64]


@dataclass(frozen=True)
class Loop:
    """Delays of one loop, from the time when a tick was due, µs."""

    what: str
    """`wake-up`, `echo`, or `torque`."""
    policy: Policy
    rate_hz: int
    ticks: int
    p50_us: float
    p99_us: float
    p999_us: float
    max_us: float
    in_time: float
    """Share of the ticks that were in time."""

    @classmethod
    def of(cls, what: str, policy: Policy, rate_hz: int, delays: Nanoseconds, limit_periods: float) -> Loop:
        """Summarise delays. limit_periods: periods from which on a tick is late."""
        p50, p99, p999 = (float(each) / 1e3 for each in np.percentile(delays, (50, 99, 99.9)))
        in_time = float(np.mean(delays <= limit_periods * 1e9 / rate_hz))
        return cls(what, policy, rate_hz, len(delays), p50, p99, p999, float(delays.max()) / 1e3, in_time)

    @property
    def is_held(self) -> bool:
        """Return whether enough ticks were in time."""
        return self.in_time >= IN_TIME_SHARE


def highest_rate(loops: list[Loop]) -> int | None:
    """Return the highest rate that was held, Hz."""
    return max((each.rate_hz for each in loops if each.is_held), default=None)


def wake_ups(policy: Policy, seconds: float) -> Iterator[Loop]:
    """Measure at each rate how late a thread wakes up that sleeps until its tick."""
    with ThreadPoolExecutor(1, "loop", initializer_of(policy)) as thread:
        for rate in RATES_HZ:
            delays = thread.submit(run_loop, rate, seconds, lambda: None).result()
            yield Loop.of("wake-up", policy, rate, delays, WAKE_UP_PERIODS)


def answers(
    what: str, policy: Policy, seconds: float, opened: Callable[[], StreamClient], motions: Array
) -> Iterator[Loop]:
    """Measure at each rate how late answers arrive over a stream of the Python client.

    The thread that reads the stream's socket has the same priority.

    Args:
        what: `echo` or `torque`.
        policy: Policy of the loop.
        seconds: Duration at each rate.
        opened: Opens the stream.
        motions: (N, 3, n) positions, velocities and accelerations, queried one after the other.
    """
    with ThreadPoolExecutor(1, "loop", initializer_of(policy)) as thread, thread.submit(opened).result() as stream:
        number = count()

        def query() -> None:
            stream.predict(*motions[next(number) % len(motions)])

        for _ in range(WARM_UP):
            thread.submit(query).result()
        for rate in RATES_HZ:
            delays = thread.submit(run_loop, rate, seconds, query).result()
            yield Loop.of(what, policy, rate, delays, ANSWER_PERIODS)


def initializer_of(policy: Policy) -> Callable[[], object] | None:
    """Return what a thread of a policy calls first."""
    return None if policy == "plain" else lambda: enter_real_time(lock_pages=False, inherit=True)


def run_loop(rate_hz: float, seconds: float, act: Callable[[], object]) -> Nanoseconds:
    """Act at each tick; return the time from each tick to the end of its act, ns."""
    clock, period = time.monotonic_ns, round(1e9 / rate_hz)
    delays = np.empty(max(1, round(rate_hz * seconds)), dtype=np.int64)
    collects = gc.isenabled()
    gc.disable()
    try:
        first = clock() + period
        end = first + round(MAX_STRETCH * len(delays) * period)
        for index in range(len(delays)):
            tick = first + index * period
            if (left := tick - clock()) > 0:
                time.sleep(left / 1e9)
            elif tick - left > end:
                delays[index:] = end - first - period * np.arange(index, len(delays))
                break
            act()
            delays[index] = clock() - tick
    finally:
        if collects:
            gc.enable()
    return delays


class EchoClient(StreamClient):
    """A stream to the service's echo, which returns each query unchanged."""

    def _begin(self) -> None:
        parts = urlsplit(self._destination.address)
        address = urlunsplit((parts.scheme, parts.netloc, ECHO_PATH, "", ""))
        self._destination = self._destination._replace(address=address)
        self._connect()  # the echo sends no description of a model

    def predict(self, q: Array, dq: Array, ddq: Array) -> None:  # type: ignore[override]
        """Send a query and wait until it is back."""
        self.send(q, dq, ddq)
        try:
            self._socket.recv(self.timeout)
        except TimeoutError as error:
            raise unanswered(self.timeout) from error
        except ConnectionClosed as error:
            raise closed(error) from error
