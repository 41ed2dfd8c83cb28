"""An arm's working day, as fast as it goes: a clock in the arm's seconds, and those who do something by it."""

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
"""The models: one is taught in batches, trained anew and refreshed; the other learns from the frames of its loop."""
BATCH_S = 2
"""Arm seconds of a batch."""
ASKED, FRAMES = 1, 2
"""Questions over HTTP and frames of the loop, each arm second."""
STREAM_S = 900
"""Arm seconds after which the loop connects anew."""
APART_S = 120
"""Arm seconds that anybody may stay behind the arm, or its learner behind in batches."""
CONTACT_S, CONTACT_NM = 300, 60.0
"""Every so many arm seconds something is touched for a fifth of one: the torque at each joint, N·m."""
PAUSE_S = 0.05
_MOST_MESSAGES = 20


class Clock:
    """Seconds of the arm. It goes on with each batch that is acknowledged, and waits for who stays behind.

    over: whether the day was ended before its time.
    """

    def __init__(self, seconds: int) -> None:
        self.seconds, self.now, self.over = seconds, 0, False
        self._places: dict[str, float] = {}
        self._changed = threading.Condition()

    def tick(self, seconds: int = 1) -> bool:
        """Some seconds are over; return whether the day goes on."""
        with self._changed:
            self.now += seconds
            self._changed.notify_all()
            self._changed.wait_for(
                lambda: self.over or self.now - min(self._places.values(), default=self.now) <= APART_S
            )
            return not self.over

    def follow(self, name: str, at: float) -> bool:
        """Wait until the arm has come to a second; return whether the day goes on. The arm waits for its followers."""
        with self._changed:
            self._places[name] = at
            self._changed.notify_all()
            self._changed.wait_for(lambda: self.over or self.now >= at)
            return not self.over

    def end(self) -> None:
        """Let everybody finish what they are at."""
        with self._changed:
            self.over = True
            self._changed.notify_all()

    def leave(self, name: str) -> None:
        """Follow no more."""
        with self._changed:
            self._places.pop(name, None)
            self._changed.notify_all()


@dataclass
class Tally:
    """What was done, by name, and what went wrong."""

    done: Counter[str] = field(default_factory=Counter)
    errors: Counter[str] = field(default_factory=Counter)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def attempt(self, name: str, act: Callable[[], Any], times: int = 1) -> None:
        """Do something and count it, or that it went wrong."""
        try:
            act()
        except (WrongAnswerError, RuntimeError, OSError, httpx.HTTPError, ValueError, KeyError, IndexError) as error:
            text = f"{name}: {type(error).__name__}: {error}"[:400]
            with self._lock:
                known = text in self.errors or len(self.errors) < _MOST_MESSAGES
                self.errors[text if known else "others"] += 1
        else:
            with self._lock:
                self.done[name] += times


@dataclass
class Day:
    """All that those who take part share. samples: what the arm does, again and again; rate: of it, Hz."""

    clock: Clock
    tally: Tally
    tcp: Address
    url: str
    key: str
    samples: Samples
    rate: int

    @property
    def headers(self) -> dict[str, str]:
        """Of every request."""
        return {"authorization": f"Bearer {self.key}"}

    def predict(self, client: HttpClient, row: int) -> Any:
        """What the arm's model answers at a motion."""
        at = row % len(self.samples)
        body = {name: getattr(self.samples, name)[at].tolist() for name in ("q", "dq", "ddq")}
        request = post(f"/v1/models/{ARM}/predict", msgspec.json.encode(body), headers=self.headers)
        return msgspec.json.decode(client.ask(request))

    def rows(self, start: int, seconds: int) -> Samples:
        """What the arm does from one of its seconds on, by its own clock."""
        first, count = start * self.rate % len(self.samples), seconds * self.rate
        rows = self.samples.rows(slice(first, first + count))
        tau = rows.tau.copy()
        if start % CONTACT_S == 0:
            tau[: self.rate // 5] += CONTACT_NM
        return replace(rows, t=start + np.arange(count) / self.rate, tau=tau)


def teach(day: Day) -> None:
    """Send each batch once; every hundredth comes twice. Wait where the learner is far behind."""
    client = HttpClient(day.tcp)

    def behind() -> int:
        answer = client.ask(get(f"/v1/models/{ARM}/learning", day.headers))
        return int(msgspec.json.decode(answer)["status"]["lag_events"])

    def batch(number: int) -> None:
        request = batch_request(ARM, ARM, number, day.rows(number * BATCH_S, BATCH_S), headers=day.headers)
        ack = send(client, request)
        if ack.duplicate or (number % 100 == 99 and not send(client, request).duplicate):
            raise WrongAnswerError(f"batch {number} is not known as what it is")
        while number % APART_S == 0 and behind() > APART_S:
            time.sleep(PAUSE_S)

    for number in range(day.clock.seconds // BATCH_S):
        day.tally.attempt(f"batch of {day.rate * BATCH_S} rows", partial(batch, number))
        if not day.clock.tick(BATCH_S):
            break
    client.close()


def ask(day: Day) -> None:
    """Ask over HTTP what is served."""
    client = HttpClient(day.tcp)

    def answers(number: int) -> None:
        for turn in range(ASKED):
            answer = day.predict(client, number * day.rate + turn)
            if not np.isfinite(answer["tau"]).all() or not np.isfinite(answer["tau_std"]).all():
                raise WrongAnswerError("a torque is not finite")

    for number in range(day.clock.seconds):
        if not day.clock.follow("ask", number):
            break
        day.tally.attempt("answer over HTTP", partial(answers, number), ASKED)
    client.close()
    day.clock.leave("ask")


def loop(day: Day) -> None:
    """Ask frame by frame over a WebSocket, with measured torque to learn from; connect anew now and then."""

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
