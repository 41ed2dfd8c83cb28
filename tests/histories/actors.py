"""Clients that write down what they ask and what they are told."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import httpx
import numpy as np

from tests.histories.checker import UNKNOWN, Operation
from tests.histories.rules import Answer
from tests.service.data import QUICK
from tests.service.learning.lessons import LESSON, QUERIES, lesson
from tests.service.server import Server

PATIENCE_S = 4.0
"""After which a client gives an answer up: longer than a service is stopped for, shorter than a restart."""
ABSENT_S = 0.05
"""After which a service that does not listen is asked again."""
ALIASES = ("production", "candidate")
WORK = "work"
"""The model that jobs train."""
ENDED = ("succeeded", "failed", "cancelled")
ACTS = {"move": 0.15, "remove": 0.05, "read": 0.2, "named": 0.2, "teach": 0.25, "ask": 0.15}
"""How often each is done."""
JOBS = 0.05
"""How often a client sees to its job instead, where there are jobs."""


@dataclass
class Book:
    """What all clients did, in the order in which it ended. named: versions that services answered through an alias."""

    operations: list[Operation] = field(default_factory=list)
    answers: list[Answer] = field(default_factory=list)
    named: list[Operation] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def write(
        self, client: int, key: str, call: tuple[Any, ...], ask: Callable[[], Any], into: list[Operation] | None = None
    ) -> Any:
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
            (self.operations if into is None else into).append(operation)
        return result

    def answered(self, answer: Answer) -> None:
        """Write down what a query was answered."""
        with self._lock:
            self.answers.append(answer)

    def of(self, kind: str) -> list[Operation]:
        """Operations about keys that begin so."""
        return [each for each in self.operations if each.key.startswith(kind)]


class Unsettled(Exception):
    """A service that could not do it now: it may have been done."""


class Client:
    """Asks one of several services, by chance, until it is told to stop.

    headers: of every request; dataset: that jobs are trained on, None where there are to be none.
    """

    def __init__(
        self,
        number: int,
        servers: Sequence[Server],
        model: str,
        book: Book,
        seed: int,
        headers: dict[str, str] | None = None,
        dataset: str | None = None,
    ) -> None:
        self.number, self.servers, self.model, self.book = number, servers, model, book
        self.headers, self.dataset = headers or {}, dataset
        self.rng = np.random.default_rng([seed, number])
        self.sequence = self.acknowledged = self.jobs = 0
        self.job: str | None = None
        self.errors: list[str] = []

    def run(self, stop: threading.Event) -> None:
        """Ask until then; what is neither an answer nor a failure of the service is kept in `errors`."""
        with httpx.Client(timeout=PATIENCE_S, headers=self.headers) as self._http:
            while not stop.is_set():
                try:
                    self.once()
                except Exception as error:
                    self.errors.append(f"client {self.number}: {type(error).__name__}: {error}")
                    return

    def once(self) -> None:
        """One operation, by chance."""
        if self.dataset is not None and self.rng.random() < JOBS:
            self._see_to_job()
            return
        alias = ALIASES[self.rng.integers(len(ALIASES))]
        key = f"alias {alias}"
        match self.rng.choice(list(ACTS), p=list(ACTS.values())):
            case "move":
                version = int(self.rng.integers(1, 4))
                self.book.write(self.number, key, ("move", version), lambda: self._move(alias, version))
            case "remove":
                self.book.write(self.number, key, ("remove",), lambda: self._remove(alias))
            case "read":
                self.book.write(self.number, key, ("read",), lambda: self._read(alias))
            case "named":
                self.book.write(self.number, key, ("read",), lambda: self._named(alias), self.book.named)
            case "ask":
                self._answer()
            case _:
                call = (self.number, self.sequence)
                result = self.book.write(self.number, "journal", call, self._teach)
                # a batch whose answer was lost is sent again, as clients do; now and then one that was answered is, too
                if result != UNKNOWN and self.rng.random() < 0.9:
                    self.sequence += 1

    def _ask(self, method: str, path: str, **request: Any) -> httpx.Response:
        server = self.servers[self.rng.integers(len(self.servers))]
        return self._ask_of(server, method, f"/v1/models/{self.model}/{path}", **request)

    def _ask_of(self, server: Server, method: str, path: str, **request: Any) -> httpx.Response:
        answer = self._http.request(method, f"{server.url}{path}", **request)
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

    def _named(self, alias: str) -> int | None:
        answer = self._ask("POST", "predict", json={**QUERIES, "alias": alias})
        assert answer.status_code in (200, 404), answer.text
        return int(answer.json()["version"]) if answer.status_code == 200 else None

    def _teach(self) -> tuple[bool, int]:
        body = lesson(self.sequence % 40, f"arm-{self.number}", sequence=self.sequence)
        # event times rise with the sequence, also once the lessons begin again
        body["t"] = [each + 10.0 * (self.sequence // 40) for each in body["t"]]
        answer = self._ask("POST", "observations", json=body)
        assert answer.status_code == 200, answer.text
        said = answer.json()
        assert said["accepted"] == LESSON, said  # whatever the clock shows
        self.acknowledged = max(self.acknowledged, int(said["revision"]))
        return bool(said["duplicate"]), int(said["revision"])

    def _answer(self) -> None:
        """Ask what is served, now and then what contains all that this client has taught."""
        server = self.servers[self.rng.integers(len(self.servers))]
        least = self.acknowledged if self.rng.random() < 0.5 else 0
        try:
            path = f"/v1/models/{self.model}/predict"
            answer = self._ask_of(server, "POST", path, json={**QUERIES, "min_revision": least})
        except (httpx.TransportError, Unsettled):
            return
        assert answer.status_code == 200, answer.text
        said = answer.json()
        # of the process that answered: another one may have taken the port since it was chosen
        life = answer.headers["x-request-id"].partition("-")[0]
        tau = tuple(float(each) for row in said["tau"] for each in row)
        self.book.answered(Answer(self.number, life, said["version"], said["revision"], least, tau))

    def _see_to_job(self) -> None:
        """Queue a job until that is acknowledged, then look at it or cancel it until it has ended."""
        key = f"job {self.number}-{self.jobs}"
        if self.job is None:
            self.book.write(self.number, key, ("queue",), lambda: self._queue(key.replace(" ", "-")))
            return
        call = "cancel" if self.rng.random() < 0.1 else "read"
        ask = self._cancel if call == "cancel" else self._look
        if self.book.write(self.number, key, (call,), ask) in ENDED:
            self.job, self.jobs = None, self.jobs + 1

    def _of_jobs(self, method: str, path: str, *expected: int, **request: Any) -> httpx.Response:
        server = self.servers[self.rng.integers(len(self.servers))]
        answer = self._ask_of(server, method, f"/v1/jobs{path}", **request)
        assert answer.status_code in expected, answer.text
        return answer

    def _queue(self, name: str) -> str:
        body = {"model": WORK, "datasets": [self.dataset], "estimator": "lip-chain", "options": QUICK, "holdout": None}
        said = self._of_jobs("POST", "", 202, json=body, headers={"Idempotency-Key": name}).json()
        self.job = said["id"]
        return str(said["state"])

    def _look(self) -> str:
        return str(self._of_jobs("GET", f"/{self.job}", 200).json()["state"])

    def _cancel(self) -> str:
        answer = self._of_jobs("POST", f"/{self.job}/cancel", 200, 409)
        return str(answer.json()["state"]) if answer.status_code == 200 else "ended"
