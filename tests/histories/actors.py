"""Clients that write down what they ask and what they are told, and what disturbs the services meanwhile."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import httpx
import numpy as np

from tests.histories.checker import UNKNOWN, Operation
from tests.service.data import DEADLINE
from tests.service.learning.lessons import QUERIES, lesson
from tests.service.server import Server

PATIENCE_S = 4.0
"""After which a client gives an answer up: longer than a service is stopped for, shorter than a restart."""
ABSENT_S = 0.05
"""After which a service that does not listen is asked again."""
ALIASES = ("production", "candidate")


@dataclass
class Book:
    """Operations of all clients, in the order that they ended in."""

    operations: list[Operation] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def write(self, client: int, key: str, call: tuple[Any, ...], ask: Callable[[], Any]) -> Any:
        """Ask, write down what came of it, and return it: UNKNOWN where no answer came, or none that says.

        Nothing is written where no service listened: then nothing can have come of it.
        """
        began = time.monotonic()
        try:
            result = ask()
        except httpx.ConnectError:
            time.sleep(ABSENT_S)
            return UNKNOWN
        except (httpx.TransportError, Unsettled):
            result = UNKNOWN
        operation = Operation(client, key, call, result, began, time.monotonic())
        with self._lock:
            self.operations.append(operation)
        return result

    def of(self, kind: str) -> list[Operation]:
        """Those about keys that begin so."""
        return [each for each in self.operations if each.key.startswith(kind)]


class Unsettled(Exception):
    """A service that could not do it now: it may have been done."""


class Client:
    """Asks one of several services, by chance, until it is told to stop."""

    def __init__(self, number: int, servers: Sequence[Server], model: str, book: Book, seed: int) -> None:
        self.number, self.servers, self.model, self.book = number, servers, model, book
        self.rng = np.random.default_rng([seed, number])
        self.sequence = 0
        self.errors: list[str] = []

    def run(self, stop: threading.Event) -> None:
        """Ask until then; what is neither an answer nor a failure of the service is kept in `errors`."""
        with httpx.Client(timeout=PATIENCE_S) as self._http:
            while not stop.is_set():
                try:
                    self.once()
                except Exception as error:
                    self.errors.append(f"{type(error).__name__}: {error}")
                    return

    def once(self) -> None:
        """One operation, by chance."""
        alias = ALIASES[self.rng.integers(len(ALIASES))]
        act = self.rng.choice(["move", "remove", "read", "answer", "teach"], p=[0.2, 0.05, 0.25, 0.25, 0.25])
        if act == "move":
            version = int(self.rng.integers(1, 4))
            self.book.write(self.number, f"alias {alias}", ("move", version), lambda: self._move(alias, version))
        elif act == "remove":
            self.book.write(self.number, f"alias {alias}", ("remove",), lambda: self._remove(alias))
        elif act == "read":
            self.book.write(self.number, f"alias {alias}", ("read",), lambda: self._read(alias))
        elif act == "answer":
            self.book.write(self.number, f"answer {alias}", ("read",), lambda: self._answer(alias))
        else:
            call = (self.number, self.sequence)
            result = self.book.write(self.number, "journal", call, self._teach)
            # a batch whose answer was lost is sent again, as clients do; now and then one that was answered is, too
            if result != UNKNOWN and self.rng.random() < 0.9:
                self.sequence += 1

    def _ask(self, method: str, path: str, **request: Any) -> httpx.Response:
        server = self.servers[self.rng.integers(len(self.servers))]
        answer = self._http.request(method, f"{server.url}/v1/models/{self.model}/{path}", **request)
        if answer.status_code in (429, 500, 503, 504):
            if answer.status_code == 500:
                self.errors.append(f"{method} {path}: {answer.text}")
            raise Unsettled(answer.text)
        return answer

    def _move(self, alias: str, version: int) -> str:
        answer = self._ask("PUT", f"aliases/{alias}", json={"version": version})
        assert answer.status_code == 200, answer.text
        assert answer.json()["version"] == version
        return "moved"

    def _remove(self, alias: str) -> str:
        answer = self._ask("DELETE", f"aliases/{alias}")
        assert answer.status_code in (204, 404), answer.text
        return "removed" if answer.status_code == 204 else "absent"

    def _read(self, alias: str) -> int | None:
        answer = self._ask("GET", "aliases")
        assert answer.status_code == 200, answer.text
        return next((each["version"] for each in answer.json()["items"] if each["alias"] == alias), None)

    def _answer(self, alias: str) -> int | None:
        answer = self._ask("POST", "predict", json={**QUERIES, "alias": alias})
        assert answer.status_code in (200, 404), answer.text
        return int(answer.json()["version"]) if answer.status_code == 200 else None

    def _teach(self) -> tuple[bool, int]:
        body = lesson(self.sequence % 40, f"arm-{self.number}", sequence=self.sequence)
        # event times rise with the sequence, also once the lessons begin again
        body["t"] = [each + 10.0 * (self.sequence // 40) for each in body["t"]]
        answer = self._ask("POST", "observations", json=body)
        assert answer.status_code == 200, answer.text
        return bool(answer.json()["duplicate"]), int(answer.json()["revision"])


class Killer:
    """Kills services outright and starts them again, or stops them for a while, by chance."""

    def __init__(self, servers: list[Server], again: Callable[[int], Server], seed: int) -> None:
        self.servers, self.again, self.rng = servers, again, np.random.default_rng([seed, 99])
        self.done: dict[str, int] = {"kill": 0, "stop": 0}
        self.errors: list[str] = []

    def run(self, stop: threading.Event, every_s: float) -> None:
        """Until then, one deed about every so many seconds."""
        try:
            while not stop.wait(self.rng.uniform(0.5, 1.5) * every_s):
                self.once(int(self.rng.integers(len(self.servers))), str(self.rng.choice(["kill", "stop"])))
        except Exception as error:
            self.errors.append(f"{type(error).__name__}: {error}")

    def once(self, number: int, deed: str) -> None:
        """One deed to one service."""
        server = self.servers[number]
        self.done[deed] += 1
        if deed == "kill":
            server.kill()
            server.client.close()
            self.servers[number] = self.again(number)
        else:
            server.process.send_signal(signal.SIGSTOP)
            try:
                time.sleep(float(self.rng.uniform(0.1, 0.5 * PATIENCE_S)))  # how long it stands still, not a wait
            finally:
                with suppress(ProcessLookupError):
                    server.process.send_signal(signal.SIGCONT)


def disturbed(clients: Sequence[Client], killer: Killer, seconds: float, every_s: float) -> list[str]:
    """Let clients ask for so long, disturbed; return what went wrong with them."""
    stop = threading.Event()
    threads = [threading.Thread(target=each.run, args=(stop,)) for each in clients]
    threads.append(threading.Thread(target=killer.run, args=(stop, every_s)))
    for each in threads:
        each.start()
    stop.wait(seconds)
    stop.set()
    for each in threads:
        each.join(DEADLINE)
    return [error for each in (*clients, killer) for error in each.errors]
