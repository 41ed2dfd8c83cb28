"""The connections of the load, and a log of each."""

from __future__ import annotations

import io
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import httpx
import msgspec
import numpy as np

from benchmarks.clients import Address, HttpClient, post
from benchmarks.online.sending import Ack, batch_request, send
from lipcore.data.samples import Array, Samples
from lipserve import StreamClient

STEADY, TAUGHT = "steady", "taught"
"""The served models: the first does not change, the second learns."""
BATCH_ROWS, BATCH_PERIOD = 25, 0.5
UPLOAD_PERIOD, MAX_DATASETS = 0.5, 10
"""Seconds between two uploads of a connection, and data sets that it keeps before it deletes the oldest."""
TOLERANCE = 1e-9
"""Max relative difference of a torque from the one computed in the process of the benchmark."""
_MAX_MESSAGES = 5


class WrongAnswerError(RuntimeError):
    """An answer is wrong."""


@dataclass(frozen=True)
class Expected:
    """Motions (N, n) and the torques (N, n) that the steady model answers."""

    q: Array
    dq: Array
    ddq: Array
    tau: Array


@dataclass
class Log:
    """Events of one connection.

    Attributes:
        kind: kind of the connection.
        times: duration of each answered exchange, ns.
        errors: count of each error message.
        acks: acknowledgements of batches, by sequence.
        stored: acknowledged sha256 and rows of each uploaded data set, by id.
        deleted: ids of data sets with acknowledged deletion.
        unsure: uploads or deletions without an answer.
    """

    kind: str
    times: list[int] = field(default_factory=list)
    errors: Counter[str] = field(default_factory=Counter)
    acks: dict[int, Ack] = field(default_factory=dict)
    stored: dict[str, dict[str, Any]] = field(default_factory=dict)
    deleted: set[str] = field(default_factory=set)
    unsure: int = 0


class Connection(ABC):
    """A connection that calls `work` repeatedly, with a pause in between."""

    kind: str
    period = 0.0

    def __init__(self, number: int) -> None:
        self.number, self.log = number, Log(self.kind)

    @abstractmethod
    def work(self, turn: int) -> None:
        """Make one exchange and log it; raise an error if it fails."""

    @abstractmethod
    def close(self) -> None:
        """Close the connection."""

    def run(self, end: float, pause: float) -> None:
        """Work until a time of `time.monotonic`; count all errors."""
        turn = 0
        while time.monotonic() < end:
            began = time.perf_counter_ns()
            try:
                self.work(turn)
                self.log.times.append(time.perf_counter_ns() - began)
            except Exception as error:  # every error counts
                text = f"{type(error).__name__}: {error}"[:300]
                known = text in self.log.errors or len(self.log.errors) < _MAX_MESSAGES
                self.log.errors[text if known else "others"] += 1
            turn += 1
            time.sleep(max(pause, self.period))
        self.close()


class Predicting(Connection):
    """A connection that predicts over HTTP: single motions and batches, with both models."""

    kind = "predict"

    def __init__(self, number: int, address: Address, expected: Expected) -> None:
        super().__init__(number)
        self._expected, self._client, self._revision = expected, HttpClient(address), 0

    def work(self, turn: int) -> None:
        """Send one query to the two models in turn, every tenth time a batch."""
        many = turn % 10 == 9
        at = (self.number + turn) % len(self._expected.q)
        rows: Any = slice(0, 20) if many else at
        model = TAUGHT if turn % 2 else STEADY
        body = {name: getattr(self._expected, name)[rows].tolist() for name in ("q", "dq", "ddq")}
        answer = msgspec.json.decode(self._client.ask(post(f"/v1/models/{model}/predict", msgspec.json.encode(body))))
        tau = np.array(answer["tau"])
        if model == STEADY:
            _check_torque(tau, self._expected.tau[rows])
            return
        if not np.isfinite(tau).all() or not np.isfinite(answer["tau_std"]).all():
            raise WrongAnswerError("A torque is not finite.")
        if answer["revision"] < self._revision:
            raise WrongAnswerError(f"Revision {answer['revision']} came after revision {self._revision}.")
        self._revision = answer["revision"]

    def close(self) -> None:
        """Close the connection."""
        self._client.close()


class Streaming(Connection):
    """A connection that predicts over a WebSocket."""

    kind = "stream"

    def __init__(self, number: int, url: str, expected: Expected) -> None:
        super().__init__(number)
        self._expected, self._client = expected, StreamClient(STEADY, url)

    def work(self, turn: int) -> None:
        """Send one query to the model that does not change."""
        expected, at = self._expected, (self.number + turn) % len(self._expected.q)
        answer = self._client.predict(expected.q[at], expected.dq[at], expected.ddq[at])
        _check_torque(np.asarray(answer.tau), expected.tau[at])

    def close(self) -> None:
        """Close the connection."""
        self._client.close()


class Observing(Connection):
    """A connection that sends observation batches of its own stream, every tenth batch twice."""

    kind, period = "observe", BATCH_PERIOD

    def __init__(self, number: int, address: Address, samples: Samples) -> None:
        super().__init__(number)
        self._samples, self._client = samples, HttpClient(address)

    def work(self, turn: int) -> None:
        """Send the next batch."""
        rows = slice(turn * BATCH_ROWS, (turn + 1) * BATCH_ROWS)
        request = batch_request(TAUGHT, stream_of(self.number), turn, self._samples.rows(rows))
        ack = send(self._client, request)
        if ack.duplicate:
            raise WrongAnswerError(f"The new batch {turn} was answered as a duplicate.")
        self.log.acks[turn] = ack
        if turn % 10 == 9 and not send(self._client, request).duplicate:
            raise WrongAnswerError(f"The repeated batch {turn} was not answered as a duplicate.")

    def close(self) -> None:
        """Close the connection."""
        self._client.close()


class Uploading(Connection):
    """A connection that uploads and lists data sets, and deletes its older ones."""

    kind, period = "upload", UPLOAD_PERIOD

    def __init__(self, number: int, url: str, samples: Samples) -> None:
        super().__init__(number)
        self._http, self._body, self._rows = httpx.Client(base_url=url, timeout=60.0), npz(samples), len(samples)

    def work(self, turn: int) -> None:
        """Upload a data set, list some, delete the oldest."""
        self.log.unsure += 1
        answer = self._http.post(
            "/v1/datasets",
            params={"name": f"load {self.number}-{turn}"},
            content=self._chunks(),
            headers={"content-type": "application/x-npz"},
        )
        dataset = _json(answer, httpx.codes.CREATED)
        self.log.stored[dataset["id"]] = {"sha256": dataset["sha256"], "rows": dataset["report"]["rows"]}
        if dataset["report"]["rows"] != self._rows:
            raise WrongAnswerError(f"The data set has {dataset['report']['rows']} rows; {self._rows} were sent.")
        _json(self._http.get("/v1/datasets", params={"limit": 5}), httpx.codes.OK)
        left = [name for name in self.log.stored if name not in self.log.deleted]
        if len(left) > MAX_DATASETS:
            _json(self._http.delete(f"/v1/datasets/{left[0]}"), httpx.codes.NO_CONTENT)
            self.log.deleted.add(left[0])
        self.log.unsure -= 1

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def _chunks(self) -> Iterator[bytes]:
        """Yield the body in chunks, without a content-length."""
        for start in range(0, len(self._body), 16_384):
            yield self._body[start : start + 16_384]


def stream_of(number: int) -> str:
    """Return the stream_id of an observing connection."""
    return f"load-{number}"


def _check_torque(found: Array, expected: Array) -> None:
    difference = float(np.abs(found - expected).max() / np.abs(expected).max())
    if not difference <= TOLERANCE:
        raise WrongAnswerError(f"A torque differs from the expected one by {difference:.1e} of the largest.")


def _json(answer: httpx.Response, status: int) -> Any:
    if answer.status_code != status:
        raise WrongAnswerError(f"{answer.request.method} {answer.request.url.path}: {answer.status_code} {answer.text}")
    return answer.json() if answer.content else None


def npz(samples: Samples) -> bytes:
    """Return a recording as an npz file."""
    file = io.BytesIO()
    np.savez(file, **{name: getattr(samples, name) for name in ("t", "q", "dq", "ddq", "tau")})
    return file.getvalue()
