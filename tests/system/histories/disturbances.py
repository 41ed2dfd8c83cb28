"""Disturbances of services while clients use them: kills, pauses, clock changes, and a broken network."""

from __future__ import annotations

import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np

from tests.service.data import DEADLINE, eventually
from tests.service.server import Server
from tests.system.histories.actors import CLIENT_TIMEOUT_S, Client
from tests.system.histories.clock import Clock
from tests.system.histories.proxy import FAULTS, Proxy

CLOCK_OFFSETS_S = (-43200.0, -3600.0, -5.0, -0.5, 0.0, 0.5, 5.0, 3600.0, 43200.0)
"""Offsets from the machine's clock."""
MAX_OUTAGE_S = 6.0
"""Longest network outage: clients time out meanwhile, and other services take over."""


MIN_OPERATIONS = 10
"""Fewest operations per client that make a history meaningful."""


class Disturbances:
    """Disturbs random services, one disturbance after the other.

    restart: starts the service of an index and returns it; clocks, proxies: of each service, if any.
    """

    def __init__(
        self,
        servers: list[Server],
        restart: Callable[[int], Server],
        seed: int,
        clocks: Sequence[Clock] = (),
        proxies: Sequence[Proxy] = (),
    ) -> None:
        self.servers, self.restart, self.clocks, self.proxies = servers, restart, clocks, proxies
        self.rng = np.random.default_rng([seed, 99])
        self.done: Counter[str] = Counter()
        self.errors: list[str] = []
        self._heal_times: dict[int, float] = {}  # monotonic times

    @property
    def kinds(self) -> list[str]:
        """The possible kinds of disturbances."""
        clocks = ["clock"] if self.clocks and Clock.movable else []
        return ["kill", "stop", *clocks, *(FAULTS if self.proxies else ())]

    def run(self, stop: threading.Event, every_s: float) -> None:
        """Disturb about every `every_s` seconds until `stop` is set; then heal the network."""
        try:
            due = time.monotonic() + every_s * self.rng.uniform(0.5, 1.5)
            while not stop.wait(max(0.0, min([due, *self._heal_times.values()]) - time.monotonic())):
                for number in [number for number, at in self._heal_times.items() if at <= time.monotonic()]:
                    self._heal(number)
                if time.monotonic() >= due:
                    self.disturb(int(self.rng.integers(len(self.servers))), str(self.rng.choice(self.kinds)))
                    due = time.monotonic() + every_s * self.rng.uniform(0.5, 1.5)
        except Exception as error:
            self.errors.append(f"trouble: {type(error).__name__}: {error}")
        for number in list(self._heal_times):
            self._heal(number)

    def disturb(self, number: int, kind: str) -> None:
        """Disturb one service."""
        self.done[kind] += 1
        if kind == "kill":
            self._heal(number)  # without a network it could not start
            self.servers[number].kill()
            self.servers[number].client.close()
            self.servers[number] = self.restart(number)
        elif kind == "stop":
            self._stop(self.servers[number])
        elif kind == "clock":
            self.clocks[number].set(float(self.rng.choice(CLOCK_OFFSETS_S)))
        else:
            self.proxies[number].set(kind)  # type: ignore[arg-type]
            self._heal_times[number] = time.monotonic() + float(self.rng.uniform(0.2, MAX_OUTAGE_S))

    def _stop(self, server: Server) -> None:
        server.process.send_signal(signal.SIGSTOP)
        try:
            time.sleep(float(self.rng.uniform(0.1, 0.5 * CLIENT_TIMEOUT_S)))  # the length of the pause
        finally:
            with suppress(ProcessLookupError):
                server.process.send_signal(signal.SIGCONT)

    def _heal(self, number: int) -> None:
        if self._heal_times.pop(number, None) is None:
            return
        if self.rng.random() < 0.5:  # data under way arrives, or is lost
            self.proxies[number].reset()
        self.proxies[number].set(None)


def run_disturbed(clients: Sequence[Client], disturbances: Disturbances, seconds: float, every_s: float) -> list[str]:
    """Let clients send requests under disturbances for a time, with a minimum of operations; return all errors."""
    stop = threading.Event()
    threads = [threading.Thread(target=each.run, args=(stop,)) for each in clients]
    threads.append(threading.Thread(target=disturbances.run, args=(stop, every_s)))
    for each in threads:
        each.start()
    stop.wait(seconds)
    with suppress(AssertionError):  # the reason is among the returned errors
        eventually(lambda: len(clients[0].history.operations) > MIN_OPERATIONS * len(clients))
    stop.set()
    for each in threads:
        each.join(DEADLINE)
    return [error for each in (*clients, disturbances) for error in each.errors]
