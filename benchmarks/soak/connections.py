"""What one connection of the load does, again and again, and what it remembers of it."""

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
"""The served models: one answers the same for ever, the other one learns."""
BATCH_ROWS, BATCH_PERIOD = 25, 0.5
UPLOAD_PERIOD, KEPT = 0.5, 10
"""Seconds between two uploads of a connection, and how many of them it keeps: older ones it deletes."""
TOLERANCE = 1e-9
"""Relative, of a torque against the one computed in the process of the benchmark."""
_MOST_MESSAGES = 5


class WrongAnswerError(RuntimeError):
    """An answer came that cannot be right."""


@dataclass(frozen=True)
class Expected:
    """Motions (N, n) and the torques (N, n) that the steady model answers."""

    q: Array
    dq: Array
    ddq: Array
    tau: Array


@dataclass
class Log:
    """What happened on one connection.

    times: ns of each exchange that was answered; acks: of batches by sequence; stored: what the service said of each
    data set that was uploaded, by id; deleted: ids that it said to have deleted; unsure: uploads or deletions without
    an answer.
    """

    kind: str
    times: list[int] = field(default_factory=list)
    errors: Counter[str] = field(default_factory=Counter)
    acks: dict[int, Ack] = field(default_factory=dict)
    stored: dict[str, dict[str, Any]] = field(default_factory=dict)
    deleted: set[str] = field(default_factory=set)
    unsure: int = 0


class Connection(ABC):
    """One connection: `work` is called again and again, with a pause in between."""

    kind: str
    period = 0.0

    def __init__(self, number: int) -> None:
        self.number, self.log = number, Log(self.kind)

    @abstractmethod
    def work(self, turn: int) -> None:
        """Exchange something and remember it; raise what goes wrong."""

    @abstractmethod
    def close(self) -> None:
        """Close the connection."""

    def run(self, end: float, pause: float) -> None:
        """Work until a moment of `time.monotonic`; everything that goes wrong is counted."""
        turn = 0
        while time.monotonic() < end:
            began = time.perf_counter_ns()
            try:
                self.work(turn)
                self.log.times.append(time.perf_counter_ns() - began)
            except Exception as error:  # whatever it is, it counts as an error of the run
                text = f"{type(error).__name__}: {error}"[:300]
                known = text in self.log.errors or len(self.log.errors) < _MOST_MESSAGES
                self.log.errors[text if known else "others"] += 1
            turn += 1
            time.sleep(max(pause, self.period))
        self.close()


class Predicting(Connection):
    """Asks over HTTP: single motions, batches, and of the model that learns too."""

    kind = "predict"

    def __init__(self, number: int, address: Address, expected: Expected) -> None:
        super().__init__(number)
        self._expected, self._client, self._revision = expected, HttpClient(address), 0

    def work(self, turn: int) -> None:
        """Ask one query of either model in turn, every tenth time a batch."""
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
            raise WrongAnswerError("a torque is not finite")
        if answer["revision"] < self._revision:
            raise WrongAnswerError(f"revision {answer['revision']} came after {self._revision}")
        self._revision = answer["revision"]

    def close(self) -> None:
        """Close the connection."""
        self._client.close()


class Streaming(Connection):
    """Asks over a WebSocket."""

    kind = "stream"

    def __init__(self, number: int, url: str, expected: Expected) -> None:
        super().__init__(number)
        self._expected, self._client = expected, StreamClient(STEADY, url)

    def work(self, turn: int) -> None:
        """Ask one query of the steady model."""
        expected, at = self._expected, (self.number + turn) % len(self._expected.q)
        answer = self._client.predict(expected.q[at], expected.dq[at], expected.ddq[at])
        _check_torque(np.asarray(answer.tau), expected.tau[at])

    def close(self) -> None:
        """Close the connection."""
        self._client.close()


class Observing(Connection):
    """Teaches the model that learns: a stream of its own, each batch sent once or, every tenth one, twice."""

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
            raise WrongAnswerError(f"batch {turn} is said to be known")
        self.log.acks[turn] = ack
        if turn % 10 == 9 and not send(self._client, request).duplicate:
            raise WrongAnswerError(f"batch {turn} was taken twice")

    def close(self) -> None:
        """Close the connection."""
        self._client.close()


class Uploading(Connection):
    """Uploads data sets, looks at them, and deletes its older ones."""

    kind, period = "upload", UPLOAD_PERIOD

    def __init__(self, number: int, url: str, samples: Samples) -> None:
        super().__init__(number)
        self._http, self._body, self._rows = httpx.Client(base_url=url, timeout=60.0), npz(samples), len(samples)

    def work(self, turn: int) -> None:
        """Upload one, list some, delete one."""
        self.log.unsure += 1
        answer = self._http.post(
            "/v1/datasets",
            params={"name": f"load {self.number}-{turn}"},
            content=self._chunks(),
            headers={"content-type": "application/x-npz"},
        )
        said = _said(answer, httpx.codes.CREATED)
        self.log.stored[said["id"]] = {"sha256": said["sha256"], "rows": said["report"]["rows"]}
        if said["report"]["rows"] != self._rows:
            raise WrongAnswerError(f"{said['report']['rows']} rows are said to be stored, {self._rows} were sent")
        _said(self._http.get("/v1/datasets", params={"limit": 5}), httpx.codes.OK)
        left = [name for name in self.log.stored if name not in self.log.deleted]
        if len(left) > KEPT:
            _said(self._http.delete(f"/v1/datasets/{left[0]}"), httpx.codes.NO_CONTENT)
            self.log.deleted.add(left[0])
        self.log.unsure -= 1

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def _chunks(self) -> Iterator[bytes]:
        """The body in pieces, as a client sends a file whose length it does not announce."""
        for start in range(0, len(self._body), 16_384):
            yield self._body[start : start + 16_384]


def stream_of(number: int) -> str:
    """Name of the stream of an observing connection."""
    return f"load-{number}"


def _check_torque(found: Array, expected: Array) -> None:
    difference = float(np.abs(found - expected).max() / np.abs(expected).max())
    if not difference <= TOLERANCE:
        raise WrongAnswerError(f"a torque differs by {difference:.1e} from the right one, relative to the largest")


def _said(answer: httpx.Response, status: int) -> Any:
    if answer.status_code != status:
        raise WrongAnswerError(f"{answer.request.method} {answer.request.url.path}: {answer.status_code} {answer.text}")
    return answer.json() if answer.content else None


def npz(samples: Samples) -> bytes:
    """A recording as a file of NumPy."""
    file = io.BytesIO()
    np.savez(file, **{name: getattr(samples, name) for name in ("t", "q", "dq", "ddq", "tau")})
    return file.getvalue()
