"""A robot that streams to a service in real time."""

import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from lipserve import StreamClient

TIMEOUT_S = 60.0
"""Timeout of an answer: the machine may be busy with other tests."""
Row = Sequence[np.ndarray]
"""q, dq, ddq and tau, (n,) each."""


@contextmanager
def playing(url: str, model: str, rows: Iterable[Row], rate: float) -> Iterator[None]:
    """Stream rows of q, dq, ddq and tau from a thread until the block ends; the model learns from them.

    An error of the stream fails the test.
    """
    stop, failures = threading.Event(), list[Exception]()

    def play() -> None:
        try:
            with StreamClient(model, url, stream_id="cell", timeout=TIMEOUT_S) as client:
                begin = time.monotonic()
                for number, (q, dq, ddq, tau) in enumerate(rows):
                    client.predict(q, dq, ddq, tau=tau)
                    if stop.wait(max(0.0, begin + number / rate - time.monotonic())):
                        return
        except Exception as error:
            failures.append(error)

    thread = threading.Thread(target=play)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
    assert failures == [], failures
