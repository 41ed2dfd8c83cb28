"""A control loop in a separate process that requests torques while the model learns."""

from __future__ import annotations

import multiprocessing
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Self

import numpy as np

from benchmarks.clients import Address
from benchmarks.latency.websocket import WebSocket, frame, request_frame
from benchmarks.timing import Timing, no_collection
from lipcore.data.samples import Array
from lipserve.frames import ANSWER, ERROR, request_bytes

RATE = 500.0
ECHO_EVERY = 5
"""Answers between two echoes of the same size, which measure the cost of transport and machine."""
_POLL_EVERY = 25
_WARM_UP = 50
_SPIN_NS = 400_000
_START_TIMEOUT_S = 60.0


@dataclass(frozen=True)
class LoopFigures:
    """Figures of a loop, times in µs.

    Attributes:
        answers: time from query to answer.
        ticks: time from the tick of the loop's clock to the answer.
        echo: time of an echo.
        revisions: time (`time.monotonic_ns`) of the first answer of each revision, and the revision.
    """

    answers: Timing
    ticks: Timing
    echo: Timing
    revisions: tuple[tuple[int, int], ...]


class LoopProcess:
    """A context manager that runs the loop; `finish` ends it and returns its figures."""

    def __init__(self, address: Address, model: str, motions: Array, rate: float = RATE) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_loop, args=(theirs, address, model, motions, rate), daemon=True)

    def __enter__(self) -> Self:
        self._process.start()
        if not self._connection.poll(_START_TIMEOUT_S):
            raise TimeoutError(f"The process of the control loop was not ready after {_START_TIMEOUT_S:g} s.")
        self._connection.recv()
        return self

    def finish(self) -> LoopFigures:
        """End the loop and return its figures; raise EOFError if its process has ended."""
        self._connection.send(None)
        figures: LoopFigures = self._connection.recv()
        return figures

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.join()
        self._connection.close()


def _loop(connection: Connection, address: Address, model: str, motions: Array, rate: float) -> None:
    """Send a query at every tick of an absolute schedule until a message arrives on the connection."""
    frames = [request_frame(motion) for motion in motions]
    period, clock, count = round(1e9 / rate), time.monotonic_ns, len(frames)
    answers: list[int] = []
    ticks: list[int] = []
    echoes: list[int] = []
    revisions: list[tuple[int, int]] = []
    last = -1
    with (
        WebSocket(address, f"/v1/models/{model}/stream") as asked,
        WebSocket(address, "/v1/echo/stream") as echo,
        no_collection(),
    ):
        echoed = frame(bytes((request_bytes(motions.shape[2]) + len(asked.ask(frames[0]))) // 2))
        for number in range(_WARM_UP):
            asked.ask(frames[number % count])
            echo.ask(echoed)
        connection.send(None)
        first, index = clock() + period, 0
        while index < ECHO_EVERY or index % _POLL_EVERY or not connection.poll():
            tick = first + index * period
            if (left := tick - clock()) > _SPIN_NS:
                time.sleep((left - _SPIN_NS) / 1e9)
            while clock() < tick:
                pass
            sent = clock()
            answer = asked.ask(frames[index % count])
            now = clock()
            answers.append(now - sent)
            ticks.append(now - tick)
            _, flags, _, _, _, revision, _ = ANSWER.unpack_from(answer)
            if flags & ERROR:
                raise RuntimeError(answer[ANSWER.size :].decode(errors="replace"))
            if revision != last:
                last = revision
                revisions.append((now, revision))
            if index % ECHO_EVERY == 0:
                began = clock()
                echo.ask(echoed)
                echoes.append(clock() - began)
            index += 1
    found = [Timing.of(np.array(each, dtype=np.int64)) for each in (answers, ticks, echoes)]
    connection.send(LoopFigures(found[0], found[1], found[2], tuple(revisions)))
