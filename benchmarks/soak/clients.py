"""The clients of the load, in several processes; each connection has a thread."""

from __future__ import annotations

import multiprocessing
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field

from benchmarks.soak.connections import Connection, Expected, Log, Observing, Predicting, Streaming, Uploading
from lipcore.data.samples import Samples

PROCESSES = 2


@dataclass(frozen=True)
class Mix:
    """Number of connections of each kind."""

    predict: int = 32
    stream: int = 8
    observe: int = 16
    upload: int = 8

    @property
    def total(self) -> int:
        """Number of all connections."""
        return self.predict + self.stream + self.observe + self.upload

    @classmethod
    def of(cls, connections: int) -> Mix:
        """Split a number of connections in the usual proportions; raise ValueError if there are fewer than 4."""
        if connections < 4:
            raise ValueError(f"At least 4 connections are required, one of each kind; got {connections}.")
        usual = cls()
        stream, observe, upload = (
            max(1, round(connections * each / usual.total)) for each in (usual.stream, usual.observe, usual.upload)
        )
        return cls(connections - stream - observe - upload, stream, observe, upload)


@dataclass(frozen=True)
class Work:
    """Work of one process of clients; observed: samples by the number of the connection that sends them."""

    tcp: tuple[str, int]
    url: str
    mix: Mix
    first: int
    seconds: float
    pause: float
    expected: Expected
    recording: Samples
    observed: dict[int, Samples] = field(default_factory=dict)


def run(works: list[Work]) -> list[Log]:
    """Run the clients of all processes at the same time; return the log of each connection."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(len(works), mp_context=context) as pool:
        logs = pool.map(_work, works)
        return [log for part in logs for log in part]


def share(total: int, parts: int) -> list[int]:
    """Split a number into parts that differ by at most one."""
    return [total // parts + (number < total % parts) for number in range(parts)]


def _work(work: Work) -> list[Log]:
    connections = _open(work)
    end = time.monotonic() + work.seconds
    threads = [threading.Thread(target=each.run, args=(end, work.pause)) for each in connections]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return [each.log for each in connections]


def _open(work: Work) -> list[Connection]:
    mix, first = work.mix, work.first
    found: list[Connection] = [Predicting(first + number, work.tcp, work.expected) for number in range(mix.predict)]
    found += [Streaming(first + number, work.url, work.expected) for number in range(mix.stream)]
    found += [Observing(number, work.tcp, samples) for number, samples in work.observed.items()]
    found += [Uploading(first + number, work.url, work.recording) for number in range(mix.upload)]
    return found
