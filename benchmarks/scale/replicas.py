"""Two services with one log: time until both have learnt all acknowledged batches, and identity of their answers."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from rich.console import Console

from benchmarks.clients import HttpClient
from benchmarks.latency.table import Grid
from benchmarks.latency.targets import Target
from benchmarks.online.sending import batch_request, send
from benchmarks.scale import streams
from benchmarks.scale.engines import Engines, eventually, ready
from benchmarks.scale.part import Part
from lipcore.data.samples import Samples
from lipserve import ApiError, Client

NAME = "replicas"
MODEL = "panda-sim"
"""The shipped model."""
BATCHES, ROWS, QUERIES = 10, 20, 100
LEARNING = {
    "enabled": True,
    "on_change": "learn",
    "contact_threshold": 100.0,
    "auto_refresh": False,
    "auto_promote": False,
}
"""All rows are learnt, and the model is not retrained."""
MAX_SECONDS = 1.0
_MAX_WAIT_S = 30.0
"""Max wait of a query for its revision; polling would take processor time from the learners."""


@dataclass(frozen=True)
class Trial:
    """Figures of batches sent to both services in turn.

    Attributes:
        first: time from the last acknowledgement until one service has learnt all batches, s.
        second: time until both have learnt them, s.
        same: whether their answers then are identical.
    """

    first: float
    second: float
    same: bool


def run(engines: Engines, trials: int, seed: int, console: Console) -> Part:
    """Send batches for one model to both services in turn, `trials` times, with running learners."""
    # give each learner a CPU, as on separate machines
    settings = {"min_revision_wait_s": _MAX_WAIT_S, "training_cpus": os.cpu_count() or 1}
    services = [engines.service(settings), engines.service(settings)]
    clients = [ready(service) for service in services]
    try:
        clients[0].put_learning(MODEL, LEARNING)
        samples = streams.stream((trials + 1) * BATCHES * ROWS, seed + 1)
        queries = streams.stream(QUERIES, seed + 2, rate=1.0)
        addresses = [("127.0.0.1", service.port) for service in services]
        _trial(addresses, clients, samples, queries, 0)
        found = []
        for number in range(1, trials + 1):
            found.append(_trial(addresses, clients, samples, queries, number))
            console.print(
                f"{number} of {trials}: both after {found[-1].second:.2f} s, "
                f"{'identical answers' if found[-1].same else 'DIFFERENT answers'}",
                highlight=False,
            )
    finally:
        for client in clients:
            client.close()
        for service in services:
            service.stop()
    return _part(found)


def _trial(
    addresses: Sequence[tuple[str, int]], clients: Sequence[Client], samples: Samples, queries: Samples, number: int
) -> Trial:
    revision = 0
    with HttpClient(addresses[0]) as one, HttpClient(addresses[1]) as other:
        for batch in range(number * BATCHES, (number + 1) * BATCHES):
            rows = samples.rows(slice(batch * ROWS, (batch + 1) * ROWS))
            ack = send((one, other)[batch % 2], batch_request(MODEL, "replicas", batch, rows))
            revision = max(revision, ack.revision)
    last = time.monotonic()

    def wait(client: Client) -> float:
        eventually(lambda: _knows(client, queries, revision), f"revision {revision}")
        return time.monotonic() - last

    with ThreadPoolExecutor(len(clients)) as pool:
        first, second = sorted(pool.map(wait, clients))
    answers = [client.predict(MODEL, queries.q, queries.dq, queries.ddq, covariance=True) for client in clients]
    one_, other_ = ([each.tau, each.tau_std, each.covariance] for each in answers)
    same = answers[0].revision == answers[1].revision and all(
        np.array_equal(np.asarray(a), np.asarray(b)) for a, b in zip(one_, other_, strict=True)
    )
    return Trial(first, second, same)


def _knows(client: Client, query: Samples, revision: int) -> bool:
    """Return whether a model answers with a revision in time."""
    with suppress(ApiError):
        answer = client.predict(MODEL, query.q[0], query.dq[0], query.ddq[0], min_revision=revision)
        return (answer.revision or 0) >= revision
    return False


def _part(found: Sequence[Trial]) -> Part:
    both = [each.second for each in found]
    same = sum(each.same for each in found)
    rows = [
        ("trials", str(len(found))),
        (f"batches of {ROWS} rows a trial, to both in turn", str(BATCHES)),
        ("s until one has learnt all: median", f"{np.median([each.first for each in found]):.2f}"),
        ("s until both have learnt all: median", f"{np.median(both):.2f}"),
        ("s until both have learnt all: worst", f"{max(both):.2f}"),
        (f"{QUERIES} identical answers, with covariances", f"{same} of {len(found)}"),
    ]
    targets = [
        Target("time until both services have learnt all, worst", max(both), "s", "<", MAX_SECONDS),
        Target("trials with different answers", len(found) - same, "", "≤", 0),
    ]
    figures = {"seconds": both, "first": [each.first for each in found], "same": same, "trials": len(found)}
    return Part(NAME, figures, [Grid("two services, one log", ("", ""), rows)], targets)
