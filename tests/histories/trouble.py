"""What disturbs services while clients ask them: kills, standstills, steps of their clocks, and a broken network."""

from __future__ import annotations

import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np

from tests.histories.actors import PATIENCE_S, Client
from tests.histories.clock import Clock
from tests.histories.proxy import FAULTS, Proxy
from tests.service.data import DEADLINE, eventually
from tests.service.server import Server

STEPS_S = (-43200.0, -3600.0, -5.0, -0.5, 0.0, 0.5, 5.0, 3600.0, 43200.0)
"""What a clock may show more than the machine's."""
PARTED_S = 6.0
"""Longest time for which a network is broken: clients give up meanwhile, and so do other services."""


SOME = 10
"""Operations of a client without which a history says little."""


class Trouble:
    """One deed after the other, by chance.

    again: starts a service anew, by its number, and returns it; clocks, proxies: of each service, where it has them.
    """

    def __init__(
        self,
        servers: list[Server],
        again: Callable[[int], Server],
        seed: int,
        clocks: Sequence[Clock] = (),
        proxies: Sequence[Proxy] = (),
    ) -> None:
        self.servers, self.again, self.clocks, self.proxies = servers, again, clocks, proxies
        self.rng = np.random.default_rng([seed, 99])
        self.done: Counter[str] = Counter()
        self.errors: list[str] = []
        self._healed: dict[int, float] = {}  # when the network of a service is to be whole again, monotonic

    @property
    def deeds(self) -> list[str]:
        """What may be done here."""
        clocks = ["clock"] if self.clocks and Clock.movable else []
        return ["kill", "stop", *clocks, *(FAULTS if self.proxies else ())]

    def run(self, stop: threading.Event, every_s: float) -> None:
        """Until then, one deed about every so many seconds; in the end the network is whole."""
        try:
            due = time.monotonic() + every_s * self.rng.uniform(0.5, 1.5)
            while not stop.wait(max(0.0, min([due, *self._healed.values()]) - time.monotonic())):
                for number in [number for number, at in self._healed.items() if at <= time.monotonic()]:
                    self._heal(number)
                if time.monotonic() >= due:
                    self.once(int(self.rng.integers(len(self.servers))), str(self.rng.choice(self.deeds)))
                    due = time.monotonic() + every_s * self.rng.uniform(0.5, 1.5)
        except Exception as error:
            self.errors.append(f"trouble: {type(error).__name__}: {error}")
        for number in list(self._healed):
            self._heal(number)

    def once(self, number: int, deed: str) -> None:
        """One deed to one service."""
        self.done[deed] += 1
        if deed == "kill":
            self._heal(number)  # it could not start
            self.servers[number].kill()
            self.servers[number].client.close()
            self.servers[number] = self.again(number)
        elif deed == "stop":
            self._stop(self.servers[number])
        elif deed == "clock":
            self.clocks[number].set(float(self.rng.choice(STEPS_S)))
        else:
            self.proxies[number].set(deed)  # type: ignore[arg-type]
            self._healed[number] = time.monotonic() + float(self.rng.uniform(0.2, PARTED_S))

    def _stop(self, server: Server) -> None:
        server.process.send_signal(signal.SIGSTOP)
        try:
            time.sleep(float(self.rng.uniform(0.1, 0.5 * PATIENCE_S)))  # how long it stands still, not a wait
        finally:
            with suppress(ProcessLookupError):
                server.process.send_signal(signal.SIGCONT)

    def _heal(self, number: int) -> None:
        if self._healed.pop(number, None) is None:
            return
        if self.rng.random() < 0.5:  # what was under way arrives after all, or never does
            self.proxies[number].reset()
        self.proxies[number].set(None)


def disturbed(clients: Sequence[Client], trouble: Trouble, seconds: float, every_s: float) -> list[str]:
    """Let clients ask for so long, and for some operations each; disturbed. Return what went wrong with them."""
    stop = threading.Event()
    threads = [threading.Thread(target=each.run, args=(stop,)) for each in clients]
    threads.append(threading.Thread(target=trouble.run, args=(stop, every_s)))
    for each in threads:
        each.start()
    stop.wait(seconds)
    with suppress(AssertionError):  # what keeps them from it is among what went wrong
        eventually(lambda: len(clients[0].book.operations) > SOME * len(clients))
    stop.set()
    for each in threads:
        each.join(DEADLINE)
    return [error for each in (*clients, trouble) for error in each.errors]
