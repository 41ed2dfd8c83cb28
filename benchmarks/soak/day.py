"""A simulated day of an arm: a clock in the arm's seconds, and the tasks that follow it."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import httpx
import msgspec
import numpy as np

from benchmarks.clients import Address, HttpClient, get, post
from benchmarks.online.sending import batch_request, send
from benchmarks.soak.connections import WrongAnswerError
from lipcore.data.samples import Samples
from lipserve import StreamClient

ARM, LOOP = "arm", "loop"
"""The models: the first learns from batches and is retrained; the second learns from the frames of its loop."""
BATCH_S = 2
"""Length of a batch, in arm seconds."""
QUERIES, FRAMES = 1, 2
"""Queries over HTTP and frames of the loop, per arm second."""
STREAM_S = 900
"""Length of a WebSocket connection, in arm seconds."""
MAX_LAG_S = 120
"""Max lag of a task behind the arm, in arm seconds, and of the learner, in batches."""
CONTACT_S, CONTACT_NM = 300, 60.0
"""Arm seconds between contacts of 0.2 s, and their torque at each joint."""
PAUSE_S = 0.05
_MAX_MESSAGES = 20


class Clock:
    """Clock in the arm's seconds, which waits for tasks that lag behind; over: whether the day was ended early."""

    def __init__(self, seconds: int) -> None:
        self.seconds, self.now, self.over = seconds, 0, False
        self._places: dict[str, float] = {}
        self._changed = threading.Condition()

    def tick(self, seconds: int = 1) -> bool:
        """Advance the clock and wait for slow tasks; return whether the day continues."""
        with self._changed:
            self.now += seconds
            self._changed.notify_all()
            self._changed.wait_for(
                lambda: self.over or self.now - min(self._places.values(), default=self.now) <= MAX_LAG_S
            )
            return not self.over

    def follow(self, name: str, at: float) -> bool:
        """Wait for a second of the arm, and let the arm wait for `name`; return whether the day continues."""
        with self._changed:
            self._places[name] = at
            self._changed.notify_all()
            self._changed.wait_for(lambda: self.over or self.now >= at)
            return not self.over

    def end(self) -> None:
        """End the day; tasks finish their present step."""
        with self._changed:
            self.over = True
            self._changed.notify_all()

    def leave(self, name: str) -> None:
        """Let the arm no longer wait for `name`."""
        with self._changed:
            self._places.pop(name, None)
            self._changed.notify_all()


@dataclass
class Tally:
    """Counts of successful steps by name, and of errors by message."""

    done: Counter[str] = field(default_factory=Counter)
    errors: Counter[str] = field(default_factory=Counter)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def attempt(self, name: str, act: Callable[[], Any], times: int = 1) -> None:
        """Perform a step and count its success or its error."""
        try:
            act()
        except (WrongAnswerError, RuntimeError, OSError, httpx.HTTPError, ValueError, KeyError, IndexError) as error:
            text = f"{name}: {type(error).__name__}: {error}"[:400]
            with self._lock:
                known = text in self.errors or len(self.errors) < _MAX_MESSAGES
                self.errors[text if known else "others"] += 1
        else:
            with self._lock:
                self.done[name] += times


@dataclass
class Day:
    """Shared state of all tasks; samples: the arm's motion, repeated all day; rate: of the samples, Hz."""

    clock: Clock
    tally: Tally
    tcp: Address
    url: str
    key: str
    samples: Samples
    rate: int

    @property
    def headers(self) -> dict[str, str]:
        """Headers of every request."""
        return {"authorization": f"Bearer {self.key}"}

    def predict(self, client: HttpClient, row: int) -> Any:
        """Return the answer of the arm's model at a motion."""
        at = row % len(self.samples)
        body = {name: getattr(self.samples, name)[at].tolist() for name in ("q", "dq", "ddq")}
        request = post(f"/v1/models/{ARM}/predict", msgspec.json.encode(body), headers=self.headers)
        return msgspec.json.decode(client.ask(request))

    def rows(self, start: int, seconds: int) -> Samples:
        """Return the arm's samples from one of its seconds on, with contacts."""
        first, count = start * self.rate % len(self.samples), seconds * self.rate
        rows = self.samples.rows(slice(first, first + count))
        tau = rows.tau.copy()
        if start % CONTACT_S == 0:
            tau[: self.rate // 5] += CONTACT_NM
        return replace(rows, t=start + np.arange(count) / self.rate, tau=tau)


def teach(day: Day) -> None:
    """Send all batches, every hundredth twice; wait if the learner lags."""
    client = HttpClient(day.tcp)

    def behind() -> int:
        answer = client.ask(get(f"/v1/models/{ARM}/learning", day.headers))
        return int(msgspec.json.decode(answer)["status"]["lag_events"])

    def batch(number: int) -> None:
        request = batch_request(ARM, ARM, number, day.rows(number * BATCH_S, BATCH_S), headers=day.headers)
        ack = send(client, request)
        if ack.duplicate or (number % 100 == 99 and not send(client, request).duplicate):
            raise WrongAnswerError(f"Batch {number} was wrongly answered as new or as a duplicate.")
        while number % MAX_LAG_S == 0 and behind() > MAX_LAG_S:
            time.sleep(PAUSE_S)

    for number in range(day.clock.seconds // BATCH_S):
        day.tally.attempt(f"batch of {day.rate * BATCH_S} rows", partial(batch, number))
        if not day.clock.tick(BATCH_S):
            break
    client.close()


def ask(day: Day) -> None:
    """Send queries over HTTP."""
    client = HttpClient(day.tcp)

    def answers(number: int) -> None:
        for turn in range(QUERIES):
            answer = day.predict(client, number * day.rate + turn)
            if not np.isfinite(answer["tau"]).all() or not np.isfinite(answer["tau_std"]).all():
                raise WrongAnswerError("A torque is not finite.")

    for number in range(day.clock.seconds):
        if not day.clock.follow("ask", number):
            break
        day.tally.attempt("answer over HTTP", partial(answers, number), QUERIES)
    client.close()
    day.clock.leave("ask")


def loop(day: Day) -> None:
    """Send frames with measured torque over a WebSocket; reconnect every STREAM_S arm seconds."""

    def frames(client: StreamClient, number: int) -> None:
        rows = day.rows(number, 1)
        for row in range(0, day.rate, day.rate // FRAMES):
            client.predict(rows.q[row], rows.dq[row], rows.ddq[row], tau=rows.tau[row])

    def connected(start: int) -> None:
        first = 1 + start * FRAMES
        with StreamClient(LOOP, day.url, stream_id=LOOP, first_sequence=first, key=day.key) as client:
            for number in range(start, min(start + STREAM_S, day.clock.seconds)):
                if not day.clock.follow("loop", number):
                    break
                day.tally.attempt("frame with torque", partial(frames, client, number), FRAMES)
            client.flush(60.0)

    for start in range(0, day.clock.seconds, STREAM_S):
        if day.clock.over:
            break
        day.tally.attempt("stream", partial(connected, start))
    day.clock.leave("loop")
