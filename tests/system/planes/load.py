"""Clients of a service: control loops, queries, observation batches and frames with torque.

Each is a thread that reconnects until it is stopped. It checks every answer, and records what was acknowledged.
"""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import httpx
import numpy as np
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from lipcore import TorqueModel
from tests.service.data import eventually
from tests.service.streams import STD, frame, read

PANDA, ARM = "panda-sim", "arm"
PERIOD_S = {"stream": 0.005, "predict": 0.02, "observations": 0.05, "frames": 0.01}
"""Seconds between two requests of a client."""
PATIENCE_S = 60.0
"""Max wait for a client to get further answers, s."""
ROWS = 5
"""Rows of an observation batch."""


def motion(number: int, n: int) -> np.ndarray:
    """Return the motion of a sequence, (4, n): q, dq, ddq and a torque."""
    return np.random.default_rng(number).uniform(-0.5, 0.5, (4, n))


class LoadClient(threading.Thread):
    """One client. `work` serves one connection, until an error of it.

    answers: times of its answers; errors: times and texts of failed connections; wrong: answers that were not right.
    """

    def __init__(self, kind: str, port: int, work: Callable[[LoadClient], None]) -> None:
        super().__init__(daemon=True, name=kind)
        self.kind, self.port, self._work = kind, port, work
        self.answers: list[float] = []
        self.errors: list[tuple[float, str]] = []
        self.wrong: list[Any] = []
        self.texts: Counter[str] = Counter()
        self.ending = threading.Event()

    def run(self) -> None:
        """Serve connections until the end."""
        while not self.ending.is_set():
            try:
                self._work(self)
            except (OSError, httpx.HTTPError, WebSocketException, EOFError) as error:
                self.errors.append((time.monotonic(), repr(error)))
                self.ending.wait(0.002)
            except Exception as error:  # a failed check
                self.wrong.append(repr(error))
                return

    def pause(self) -> None:
        """Wait for the next request."""
        self.ending.wait(PERIOD_S[self.kind])

    def answered(self) -> None:
        """Record an answer."""
        self.answers.append(time.monotonic())

    def check(self, right: bool, what: Any) -> None:
        """Record a wrong answer."""
        if not right:
            self.wrong.append(what)

    def wait_for(self, more: int) -> None:
        """Wait for further answers."""
        expected = len(self.answers) + more
        eventually(lambda: self.wrong or len(self.answers) >= expected, PATIENCE_S)
        assert self.wrong == []

    def largest_gap(self, since: float) -> float:
        """Return the largest time between two answers after a time, s."""
        times = [each for each in self.answers if each > since - 0.5]
        return max(np.diff(times), default=0.0)

    def connection(self, path: str) -> ClientConnection:
        """Return a stream, after its first message."""
        options = {"compression": None, "open_timeout": 5, "close_timeout": 1, "legacy": True}
        made: ClientConnection = connect(f"ws://127.0.0.1:{self.port}{path}", **options)  # type: ignore[assignment]
        made.recv(5)
        return made


class Load:
    """All clients of a service; a context manager. model: version 1 of PANDA, whose answers never change."""

    def __init__(self, port: int, model: TorqueModel) -> None:
        self.port, self.model = port, model
        self.acknowledged: set[int] = set()
        """Sequences of observation batches that were acknowledged."""
        self.learnt: set[int] = set()
        """Sequences of frames that were acknowledged."""
        self.refused: set[int] = set()
        """Sequences of frames that were refused."""
        self.revision = 0
        """Revision of the last answer of ARM."""
        self._batch, self._frame = 0, 0
        works = {
            "stream": self._stream,
            "predict": self._predict,
            "observations": self._observations,
            "frames": self._frames,
        }
        self.clients = {kind: LoadClient(kind, port, work) for kind, work in works.items()}

    def expected(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return torque and standard deviation of the model in this process."""
        answer = self.model.fast.answer_fully(motion(number, 7)[:3])
        return answer.tau, answer.tau_std

    def check(self, client: LoadClient, number: int, tau: Any, std: Any) -> None:
        """Compare an answer with the model in this process."""
        known = self.expected(number)
        client.check(np.allclose((tau, std), known, rtol=1e-9, atol=1e-12), (number, tau, known))

    def _stream(self, client: LoadClient) -> None:
        with client.connection(f"/v1/models/{PANDA}/stream?version=1") as stream:
            number = 0
            while not client.ending.is_set():
                number = number % 1000 + 1
                stream.send(frame(motion(number, 7)[:3], number, STD))
                answer = read(stream.recv(5))
                client.check(answer.sequence == number and answer.error is None, answer)
                self.check(client, number, answer.tau, answer.std)
                client.answered()
                client.pause()

    def _predict(self, client: LoadClient) -> None:
        with httpx.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=5) as http:
            number = 0
            while not client.ending.is_set():
                number = number % 1000 + 1
                q, dq, ddq, _ = motion(number, 7).tolist()
                asked = {"q": q, "dq": dq, "ddq": ddq, "version": 1}
                answer = http.post(f"/v1/models/{PANDA}/predict", json=asked)
                client.check(answer.status_code == httpx.codes.OK, answer.text)
                self.check(client, number, answer.json()["tau"], answer.json()["tau_std"])
                client.answered()
                client.pause()

    def _observations(self, client: LoadClient) -> None:
        with httpx.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=5) as http:
            while not client.ending.is_set():
                rows = np.array([motion(ROWS * self._batch + row, 2) for row in range(ROWS)])
                named = dict(zip(("q", "dq", "ddq", "tau"), rows.transpose(1, 0, 2).tolist(), strict=True))
                t = [0.01 * (ROWS * self._batch + row) for row in range(ROWS)]
                asked = {"stream_id": "robot-1", "sequence": self._batch, "t": t, **named}
                answer = http.post(f"/v1/models/{ARM}/observations", json=asked)
                if answer.status_code == httpx.codes.SERVICE_UNAVAILABLE:
                    raise EOFError(answer.text)  # sent again
                client.check(answer.status_code == httpx.codes.OK, answer.text)
                self.acknowledged.add(self._batch)
                self._batch += 1
                client.answered()
                client.pause()

    def _frames(self, client: LoadClient) -> None:
        sent = sorted(set(range(self._frame)) - self.learnt - self.refused)
        with client.connection(f"/v1/models/{ARM}/stream?stream_id=arm-1") as stream:
            # frames of the last connection without an acknowledgement are sent again
            self._frame = sent[0] if sent else self._frame
            while not client.ending.is_set():
                values = motion(self._frame, 2)
                stream.send(frame(values[:3], self._frame, STD, tau=values[3]))
                self._frame += 1
                while isinstance(message := stream.recv(5), str):
                    self._note(client, json.loads(message))
                answer = read(message)
                client.check(answer.error is None, answer)
                self.revision = answer.revision
                client.answered()
                client.pause()
            with suppress(TimeoutError):
                while True:
                    message = stream.recv(1)
                    if isinstance(message, str):
                        self._note(client, json.loads(message))

    def _note(self, client: LoadClient, message: dict[str, Any]) -> None:
        """Record an acknowledgement: frames are learnt or refused in the order of their sequences."""
        if "learnt" in message:
            through = message["learnt"]["through"]
            new = set(range(through + 1)) - self.learnt - self.refused
            self.learnt |= new
        elif "refused" in message:
            refused = message["refused"]
            client.texts[refused["error"]["code"]] += 1
            self.refused |= set(range(refused["first"], refused["through"] + 1))

    def wait_for(self, more: int, *kinds: str) -> None:
        """Wait until clients have further answers; all if none is named."""
        for kind in kinds or self.clients:
            self.clients[kind].wait_for(more)

    def __enter__(self) -> Load:
        for client in self.clients.values():
            client.start()
        self.wait_for(20)
        return self

    def __exit__(self, *_: object) -> None:
        for client in self.clients.values():
            client.ending.set()
        for client in self.clients.values():
            client.join(PATIENCE_S)
            assert not client.is_alive(), client.kind
