"""The loop that plays a motion in real time."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from service.cli.playing.source import Motion
from service.cli.playing.tally import Tally
from service.client.stream import StreamClient, StreamError

NAP = 0.05
"""Longest sleep, s: so soon a Ctrl-C is heard."""


class Stop:
    """Whether Ctrl-C was pressed. The first lets the row that is under way be answered; the second ends it at once."""

    def __init__(self) -> None:
        self.asked = False

    @contextmanager
    def heard(self) -> Iterator[Stop]:
        """Listen for Ctrl-C, in the main thread, which alone hears it."""
        if threading.current_thread() is not threading.main_thread():
            yield self
            return
        before = signal.signal(signal.SIGINT, self._ask)
        try:
            yield self
        finally:
            signal.signal(signal.SIGINT, before)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True


def play(
    stream: StreamClient,
    motion: Motion,
    learn: bool,
    deadline: float,
    stop: Stop,
    each_second: Callable[[int, Tally], None],
) -> Tally:
    """Ask for the torque at each row when it is due, and send what was measured there where it is to be learnt.

    A row that is refused is counted and the next one is sent; rows that are due already follow without a pause. Raise
    StreamError where the stream is lost. each_second: is told which second of the playing has ended, and its figures.
    """
    whole, part = Tally(stream.hello.noise_std), Tally(stream.hello.noise_std)
    due = motion.t - motion.t[0]
    begin, second = time.perf_counter(), 1
    for row in range(len(motion)):
        while (wait := begin + due[row] - time.perf_counter()) > 0 and not stop.asked:
            time.sleep(min(wait, NAP))
        if stop.asked:
            break
        sent = time.perf_counter()
        if sent - begin >= second:
            each_second(second, part)
            whole.merge(part)
            part, second = Tally(stream.hello.noise_std), int(sent - begin) + 1
            sent = time.perf_counter()
        tau = motion.tau[row] if learn else None
        try:
            answer = stream.ask(motion.q[row], motion.dq[row], motion.ddq[row], deadline=deadline, tau=tau)
        except StreamError as error:
            if error.sequence is None:
                raise
            part.refused[error.code] += 1
            continue
        part.add(answer, motion.tau[row], time.perf_counter() - sent, max(0.0, -wait))
    if part.rows or part.refused:
        each_second(second, part)
        whole.merge(part)
    return whole
