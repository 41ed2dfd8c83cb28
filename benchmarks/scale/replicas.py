"""Two services that follow one log: how long until both answer with all that was acknowledged, and the same bits."""

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
"""The model that every service brings."""
BATCHES, ROWS, QUERIES = 10, 20, 100
LEARNING = {
    "enabled": True,
    "on_change": "learn",
    "contact_threshold": 100.0,
    "auto_refresh": False,
    "auto_promote": False,
}
"""Every row is learnt, and nothing else happens."""
MOST_SECONDS = 1.0
_WAIT = 30.0
"""Longest wait of a query for the revision it asks for, s: asked once, as asking again and again takes what learns."""


@dataclass(frozen=True)
class Trial:
    """Batches to both services in turn. seconds: from the last acknowledgement until the first and the second service
    answered with all of them; same: whether their answers then had the same bits."""

    first: float
    second: float
    same: bool


def run(engines: Engines, trials: int, seed: int, console: Console) -> Part:
    """Teach one model through both services alternately, so many times; their learners run when that begins."""
    # on one machine: services on machines of their own leave each learner a CPU, too
    settings = {"min_revision_wait_s": _WAIT, "training_cpus": os.cpu_count() or 1}
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
                f"{'the same bits' if found[-1].same else 'DIFFERENT bits'}",
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
    """Ask for an answer that stands on a revision; False where there is none in time."""
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
        ("s until one has all: median", f"{np.median([each.first for each in found]):.2f}"),
        ("s until both have all: median", f"{np.median(both):.2f}"),
        ("s until both have all: worst", f"{max(both):.2f}"),
        (f"same bits of {QUERIES} answers, with covariances", f"{same} of {len(found)}"),
    ]
    targets = [
        Target("both services have the last acknowledged batch, worst", max(both), "s", "<", MOST_SECONDS),
        Target("trials in which their answers differ", len(found) - same, "", "≤", 0),
    ]
    figures = {"seconds": both, "first": [each.first for each in found], "same": same, "trials": len(found)}
    return Part(NAME, figures, [Grid("two services, one log", ("", ""), rows)], targets)
