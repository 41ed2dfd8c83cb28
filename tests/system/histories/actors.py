"""Clients that record their requests and the responses."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import httpx
import numpy as np

from tests.service.data import QUICK
from tests.service.learning.learning_models import BATCH_ROWS, QUERIES, observation_batch
from tests.service.server import Server
from tests.system.histories.checker import UNKNOWN, Operation
from tests.system.histories.rules import Answer

CLIENT_TIMEOUT_S = 4.0
"""Timeout of a client: longer than a service is stopped, shorter than a restart."""
RETRY_AFTER_S = 0.05
"""Pause after a refused connection."""
ALIASES = ("production", "candidate")
JOB_MODEL = "work"
"""The model that jobs train."""
END_STATES = ("succeeded", "failed", "cancelled")
OPERATION_SHARES = {"move": 0.15, "remove": 0.05, "read": 0.2, "named": 0.2, "teach": 0.25, "ask": 0.15}
"""Share of each operation."""
JOB_SHARE = 0.05
"""Share of job operations, if there are jobs."""


@dataclass
class History:
    """The operations of all clients, in the order of their end. alias_reads: versions of predictions through an
    alias."""

    operations: list[Operation] = field(default_factory=list)
    answers: list[Answer] = field(default_factory=list)
    alias_reads: list[Operation] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def record(
        self, client: int, key: str, call: tuple[Any, ...], send: Callable[[], Any], into: list[Operation] | None = None
    ) -> Any:
        """Send a request, record the operation, and return its result; UNKNOWN if its outcome is unknown.

        Nothing is recorded if the connection was refused, because the request had no effect.
        """
        began = time.monotonic()
        try:
            result = send()
        except httpx.ConnectError:
            time.sleep(RETRY_AFTER_S)
            return UNKNOWN
        except (httpx.TransportError, OutcomeUnknownError):
            result = UNKNOWN
        operation = Operation(client, key, call, result, began, time.monotonic())
        with self._lock:
            (self.operations if into is None else into).append(operation)
        return result

    def record_answer(self, answer: Answer) -> None:
        """Record the response to a prediction."""
        with self._lock:
            self.answers.append(answer)

    def operations_on(self, kind: str) -> list[Operation]:
        """Return the operations on keys of a kind."""
        return [each for each in self.operations if each.key.startswith(kind)]


class OutcomeUnknownError(Exception):
    """The service could not complete the request, which may or may not have taken effect."""


class Client:
    """Sends random requests to random services until it is stopped.

    headers: of every request; dataset: that jobs are trained on, None for no jobs.
    """

    def __init__(
        self,
        number: int,
        servers: Sequence[Server],
        model: str,
        history: History,
        seed: int,
        headers: dict[str, str] | None = None,
        dataset: str | None = None,
    ) -> None:
        self.number, self.servers, self.model, self.history = number, servers, model, history
        self.headers, self.dataset = headers or {}, dataset
        self.rng = np.random.default_rng([seed, number])
        self.sequence = self.acknowledged = self.jobs = 0
        self.job: str | None = None
        self.errors: list[str] = []

    def run(self, stop: threading.Event) -> None:
        """Send requests until `stop` is set; unexpected responses are kept in `errors`."""
        with httpx.Client(timeout=CLIENT_TIMEOUT_S, headers=self.headers) as self._http:
            while not stop.is_set():
                try:
                    self.run_one_operation()
                except Exception as error:
                    self.errors.append(f"client {self.number}: {type(error).__name__}: {error}")
                    return

    def run_one_operation(self) -> None:
        """Run one random operation."""
        if self.dataset is not None and self.rng.random() < JOB_SHARE:
            self._advance_job()
            return
        alias = ALIASES[self.rng.integers(len(ALIASES))]
        key = f"alias {alias}"
        match self.rng.choice(list(OPERATION_SHARES), p=list(OPERATION_SHARES.values())):
            case "move":
                version = int(self.rng.integers(1, 4))
                self.history.record(self.number, key, ("move", version), lambda: self._move(alias, version))
            case "remove":
                self.history.record(self.number, key, ("remove",), lambda: self._remove(alias))
            case "read":
                self.history.record(self.number, key, ("read",), lambda: self._read(alias))
            case "named":
                self.history.record(
                    self.number, key, ("read",), lambda: self._read_through_alias(alias), self.history.alias_reads
                )
            case "ask":
                self._predict()
            case _:
                call = (self.number, self.sequence)
                result = self.history.record(self.number, "journal", call, self._send_batch)
                # a client resends a batch without a response; resend some answered ones too, as duplicates
                if result != UNKNOWN and self.rng.random() < 0.9:
                    self.sequence += 1

    def _request(self, method: str, path: str, **request: Any) -> httpx.Response:
        server = self.servers[self.rng.integers(len(self.servers))]
        return self._request_from(server, method, f"/v1/models/{self.model}/{path}", **request)

    def _request_from(self, server: Server, method: str, path: str, **request: Any) -> httpx.Response:
        answer = self._http.request(method, f"{server.url}{path}", **request)
        if answer.status_code in (429, 500, 503, 504):
            if answer.status_code == 500:
                self.errors.append(f"{method} {path}: {answer.text}")
            raise OutcomeUnknownError(answer.text)
        return answer

    def _move(self, alias: str, version: int) -> str:
        answer = self._request("PUT", f"aliases/{alias}", json={"version": version})
        assert answer.status_code == 200, answer.text
        assert answer.json()["version"] == version
        return "moved"

    def _remove(self, alias: str) -> str:
        answer = self._request("DELETE", f"aliases/{alias}")
        assert answer.status_code in (204, 404), answer.text
        return "removed" if answer.status_code == 204 else "absent"

    def _read(self, alias: str) -> int | None:
        answer = self._request("GET", "aliases")
        assert answer.status_code == 200, answer.text
        return next((each["version"] for each in answer.json()["items"] if each["alias"] == alias), None)

    def _read_through_alias(self, alias: str) -> int | None:
        answer = self._request("POST", "predict", json={**QUERIES, "alias": alias})
        assert answer.status_code in (200, 404), answer.text
        return int(answer.json()["version"]) if answer.status_code == 200 else None

    def _send_batch(self) -> tuple[bool, int]:
        body = observation_batch(self.sequence % 40, f"arm-{self.number}", sequence=self.sequence)
        # event times must rise with the sequence, also when the batches repeat
        body["t"] = [each + 10.0 * (self.sequence // 40) for each in body["t"]]
        answer = self._request("POST", "observations", json=body)
        assert answer.status_code == 200, answer.text
        response = answer.json()
        assert response["accepted"] == BATCH_ROWS, response  # independent of the clock
        self.acknowledged = max(self.acknowledged, int(response["revision"]))
        return bool(response["duplicate"]), int(response["revision"])

    def _predict(self) -> None:
        """Predict, in half of the requests with the newest revision that this client got as the minimum."""
        server = self.servers[self.rng.integers(len(self.servers))]
        min_revision = self.acknowledged if self.rng.random() < 0.5 else 0
        try:
            path = f"/v1/models/{self.model}/predict"
            answer = self._request_from(server, "POST", path, json={**QUERIES, "min_revision": min_revision})
        except (httpx.TransportError, OutcomeUnknownError):
            return
        assert answer.status_code == 200, answer.text
        response = answer.json()
        # identify the process by its response: another one may have taken over the port
        server_start = answer.headers["x-request-id"].partition("-")[0]
        tau = tuple(float(each) for row in response["tau"] for each in row)
        self.history.record_answer(
            Answer(self.number, server_start, response["version"], response["revision"], min_revision, tau)
        )

    def _advance_job(self) -> None:
        """Queue a job until it is acknowledged, then read or cancel it until it has ended."""
        key = f"job {self.number}-{self.jobs}"
        if self.job is None:
            self.history.record(self.number, key, ("queue",), lambda: self._queue_job(key.replace(" ", "-")))
            return
        call = "cancel" if self.rng.random() < 0.1 else "read"
        send = self._cancel_job if call == "cancel" else self._read_job
        if self.history.record(self.number, key, (call,), send) in END_STATES:
            self.job, self.jobs = None, self.jobs + 1

    def _request_jobs(self, method: str, path: str, *expected: int, **request: Any) -> httpx.Response:
        server = self.servers[self.rng.integers(len(self.servers))]
        answer = self._request_from(server, method, f"/v1/jobs{path}", **request)
        assert answer.status_code in expected, answer.text
        return answer

    def _queue_job(self, name: str) -> str:
        body = {
            "model": JOB_MODEL,
            "datasets": [self.dataset],
            "estimator": "lip-chain",
            "options": QUICK,
            "holdout": None,
        }
        response = self._request_jobs("POST", "", 202, json=body, headers={"Idempotency-Key": name}).json()
        self.job = response["id"]
        return str(response["state"])

    def _read_job(self) -> str:
        return str(self._request_jobs("GET", f"/{self.job}", 200).json()["state"])

    def _cancel_job(self) -> str:
        answer = self._request_jobs("POST", f"/{self.job}/cancel", 200, 409)
        return str(answer.json()["state"]) if answer.status_code == 200 else "ended"
