"""Processor time, memory and bytes of a batch, a sample, a query and a model: the constants of docs/sizing.md."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.clients import HttpClient, post
from benchmarks.latency.table import NOTHING, Grid
from benchmarks.online.sending import batch_request, send
from benchmarks.online.trials import learners
from benchmarks.processes import resident_mib
from benchmarks.processor import seconds_below
from benchmarks.scale import plan, streams
from benchmarks.scale.engines import Engines, eventually, ready, stored
from benchmarks.scale.part import Part
from benchmarks.scale.replicas import LEARNING, MODEL
from lipcore.data.samples import Samples
from lipserve import Client, StreamClient
from service.cli.demo import ServiceProcess
from service.foundation.settings import shipped_models

NAME = "costs"
ROWS = (1, 10, 100)
"""Sizes of batches; the line through these gives the costs of a batch and of a sample."""
COPIES = 6
"""Copies of the model, to measure the memory of one."""
IDLE_SECONDS, PACED_SECONDS = 5.0, 10
KIB = 1024.0


@dataclass(frozen=True)
class Batches:
    """Costs of a batch of one size and one service.

    Attributes:
        rows: rows of the batch.
        shared: whether the service uses PostgreSQL and S3.
        ack_ms: median time to acknowledgement.
        ack_p99_ms: 99th percentile of it.
        service_ms: processor time of the service's own process.
        learner_ms: processor time of its learner.
        database_ms: processor time of the database server; None for SQLite.
        stored_bytes: growth of the database; None for SQLite.
    """

    rows: int
    shared: bool
    ack_ms: float
    ack_p99_ms: float
    service_ms: float
    learner_ms: float
    database_ms: float | None
    stored_bytes: float | None


class Subject:
    """A service that learns, and the processor time of its processes."""

    def __init__(self, service: ServiceProcess, client: Client, engines: Engines | None) -> None:
        self.service, self.client, self.engines = service, client, engines
        self.http = HttpClient(("127.0.0.1", service.port))
        self.sequence = 0
        self.revision = 0

    def teach(self, samples: Samples) -> float:
        """Send the next batch; return the milliseconds until its acknowledgement."""
        ack = send(self.http, batch_request(MODEL, "costs", self.sequence, samples))
        self.sequence, self.revision = self.sequence + 1, ack.revision
        return 1e3 * ack.seconds

    def caught_up(self, query: Samples) -> None:
        """Wait until all batches are learnt."""
        eventually(partial(_knows, self.client, MODEL, query, self.revision), "learning of all batches", 120.0)

    def used(self) -> tuple[float, float, float]:
        """Return seconds of processor time so far of service, learner and database server."""
        pid = self.service.process.pid
        learner = sum(seconds_below(each, itself=True) for each in learners(pid))
        own = seconds_below(pid, itself=True) - seconds_below(pid)
        return own, learner, 0.0 if self.engines is None else seconds_below(self.engines.postgres.pid, itself=True)

    def size(self) -> int:
        """Return the size of the database in bytes; 0 for SQLite."""
        if self.engines is None:
            return 0
        return int(
            self.engines.postgres.ask("SELECT pg_database_size(current_database())", self.engines.database)[0][0]
        )


def run(engines: Engines, batches: int, queries: int, seed: int, console: Console) -> Part:
    """Measure two services in turn, one with PostgreSQL and S3, one with SQLite."""
    settings = {"max_loaded_models": COPIES + 2}
    services = [engines.service(settings), engines.alone(settings)]
    subjects = [Subject(each, ready(each), engines if each is services[0] else None) for each in services]
    query = streams.stream(50, seed + 4, rate=1.0)
    for subject in subjects:
        subject.client.put_learning(MODEL, LEARNING)
        subject.teach(streams.stream(10, seed + 5))  # start its learner
        subject.caught_up(query)
    found: list[Batches] = []
    for rows in ROWS:
        console.print(f"{batches} batches of {rows} rows to PostgreSQL and SQLite in turn", highlight=False)
        found += _batches(subjects, streams.stream(batches * rows + 1, seed + 6 + rows), rows, batches, query)
    shared = subjects[0]
    console.print(f"{queries} queries", highlight=False)
    figures: dict[str, Any] = {"batches": [asdict(each) for each in found]}
    figures["query_http_us"] = _http_query(shared, query, queries)
    figures["query_stream_us"] = _stream_query(shared, query, queries)
    figures["idle_ms_per_s"] = _idle(shared)
    figures["taught_ms_per_s"] = _paced(shared, streams.stream(2 * PACED_SECONDS, seed + 7), query)
    figures |= _memory(shared, engines, query)
    figures |= _files(engines)
    for subject in subjects:
        subject.http.close()
        subject.client.close()
        subject.service.stop()
    line = {name: _line(found, name) for name in ("service_ms", "learner_ms", "database_ms", "stored_bytes")}
    figures |= {name: {"batch": ends[0], "sample": ends[1]} for name, ends in line.items()}
    notes = [f"Plans: a training job takes {_job_seconds():.0f} s of one CPU, as for {MODEL}; see docs/sizing.md."]
    return Part(NAME, figures, [_batch_grid(found), _constants(figures), plan.grid(figures, _job_seconds())], [], notes)


def _job_seconds() -> float:
    """Return the time of the shipped model's fit."""
    return float(json.loads((shipped_models() / MODEL / "manifest.json").read_bytes())["fit"]["seconds"])


def _batches(subjects: Sequence[Subject], samples: Samples, rows: int, count: int, query: Samples) -> list[Batches]:
    """Send batches of one size to all subjects in turn; measure until all are learnt."""
    acks: list[list[float]] = [[] for _ in subjects]
    before = [(subject.used(), subject.size()) for subject in subjects]
    for number in range(count):
        part = samples.rows(slice(number * rows, (number + 1) * rows))
        for place, subject in enumerate(subjects):
            acks[place].append(subject.teach(part))
    found = []
    for subject in subjects:
        subject.caught_up(query)
    for subject, times, (used, size) in zip(subjects, acks, before, strict=True):
        own, learner, database = (1e3 * (now - then) / count for now, then in zip(subject.used(), used, strict=True))
        shared = subject.engines is not None
        grown = (subject.size() - size) / count if shared else None
        p50, p99 = np.percentile(times, (50, 99))
        found.append(Batches(rows, shared, float(p50), float(p99), own, learner, database if shared else None, grown))
    return found


def _http_query(subject: Subject, query: Samples, count: int) -> float:
    body = {"q": query.q[0].tolist(), "dq": query.dq[0].tolist(), "ddq": query.ddq[0].tolist()}
    request = post(f"/v1/models/{MODEL}/predict", json.dumps(body).encode())
    return _each(subject, lambda: subject.http.ask(request), count)


def _stream_query(subject: Subject, query: Samples, count: int) -> float:
    with StreamClient(MODEL, url=subject.service.url) as stream:
        return _each(subject, lambda: stream.predict(query.q[0], query.dq[0], query.ddq[0]), count)


def _each(subject: Subject, ask: Callable[[], object], count: int) -> float:
    """Return the service's processor time a call, µs."""
    before = subject.used()[0]
    for _ in range(count):
        ask()
    return 1e6 * (subject.used()[0] - before) / count


def _idle(subject: Subject) -> float:
    """Return processor time of an idle service and its learner, ms per second."""
    before = subject.used()
    time.sleep(IDLE_SECONDS)
    after = subject.used()
    return 1e3 * sum(now - then for now, then in zip(after[:2], before[:2], strict=True)) / IDLE_SECONDS


def _paced(subject: Subject, samples: Samples, query: Samples) -> float:
    """Return the learner's processor time for a model that learns one row a second, ms per second.

    Nearly all of it is the cost of revisions; a revision contains all rows since the previous one.
    """
    before = subject.used()[1]
    for number in range(PACED_SECONDS):
        subject.teach(samples.rows(slice(number, number + 1)))
        time.sleep(1.0)
    subject.caught_up(query)
    return 1e3 * (subject.used()[1] - before) / PACED_SECONDS


def _memory(subject: Subject, engines: Engines, query: Samples) -> dict[str, float | None]:
    """Return memory of service and learner, and of one more loaded and one more learning model, MiB."""
    pid, client = subject.service.process.pid, subject.client
    archive = engines.folder / "model.tar"
    client.export(MODEL, archive, learnt=False)
    before = resident_mib(pid)
    names = [f"copy-{number}" for number in range(COPIES)]
    for name in names:
        client.import_model(archive, name, "always")
        client.put_learning(name, LEARNING)
        client.predict(name, query.q[0], query.dq[0], query.ddq[0])
    loaded = resident_mib(pid)
    learner = learners(pid)[0]
    idle = resident_mib(learner)
    for name in names:
        revision = json.loads(subject.http.ask(batch_request(name, "costs", 0, query)))["revision"]
        eventually(partial(_knows, client, name, query, revision), "learning of all batches", 120.0)
    taught = resident_mib(learner)
    return {
        "service_mib": before,
        "learner_mib": idle,
        "loaded_mib": _share(before, loaded),
        "taught_mib": _share(idle, taught),
    }


def _files(engines: Engines) -> dict[str, float | None]:
    """Return the bytes of one stored version and of one snapshot."""
    found = stored(engines)
    snapshots = found.get("learning")
    versions = [row[0] for row in engines.postgres.ask("SELECT count(*) FROM versions", engines.database)]
    size = found.get("versions")
    return {
        "snapshot_bytes": None if not snapshots else snapshots[1] / snapshots[0],
        "version_bytes": None if not size else size[1] / max(1, versions[0]),
    }


def _knows(client: Client, model: str, query: Samples, revision: int) -> bool:
    """Return whether a model answers with a revision."""
    return client.predict(model, query.q[0], query.dq[0], query.ddq[0]).revision >= revision


def _share(before: float | None, after: float | None) -> float | None:
    return None if before is None or after is None else (after - before) / COPIES


def _line(found: Sequence[Batches], name: str) -> tuple[float, float]:
    """Return costs of a batch and of a sample with PostgreSQL, from the smallest and the largest batches."""
    shared = [each for each in found if each.shared]
    small, large = shared[0], shared[-1]
    low, high = getattr(small, name), getattr(large, name)
    slope = (high - low) / (large.rows - small.rows)
    return low - slope * small.rows, slope


def _batch_grid(found: Sequence[Batches]) -> Grid:
    columns = (
        *("rows a batch", "database", "ack ms p50", "ack ms p99"),
        *("service CPU ms", "learner CPU ms", "database CPU ms", "bytes stored"),
    )
    rows = []
    for each in found:
        times = (each.ack_ms, each.ack_p99_ms, each.service_ms, each.learner_ms, each.database_ms)
        stored_ = NOTHING if each.stored_bytes is None else f"{each.stored_bytes:,.0f}"
        rows.append((str(each.rows), "PostgreSQL" if each.shared else "SQLite", *map(_text, times), stored_))
    return Grid("a batch of observations, from one client", columns, rows)


def _constants(figures: dict[str, Any]) -> Grid:
    both = [
        ("service CPU", "service_ms", "ms"),
        ("learner CPU", "learner_ms", "ms"),
        ("database CPU", "database_ms", "ms"),
    ]
    rows = [(f"{label} of a batch", _text(figures[name]["batch"]), unit) for label, name, unit in both]
    rows += [(f"{label} of a sample", _text(figures[name]["sample"]), unit) for label, name, unit in both]
    rows += [
        ("database size of a batch", _text(figures["stored_bytes"]["batch"]), "bytes"),
        ("database size of a sample", _text(figures["stored_bytes"]["sample"]), "bytes"),
        ("CPU of a query over HTTP", _text(figures["query_http_us"]), "µs"),
        ("CPU of a query over a WebSocket", _text(figures["query_stream_us"]), "µs"),
        ("CPU of a service and its learner, idle", _text(figures["idle_ms_per_s"]), "ms/s"),
        ("learner CPU of a model that learns a row a second", _text(figures["taught_ms_per_s"]), "ms/s"),
        ("a service without copies of the model", _text(figures["service_mib"]), "MiB"),
        ("a loaded model", _text(figures["loaded_mib"]), "MiB"),
        ("its learner, with one model", _text(figures["learner_mib"]), "MiB"),
        ("a learning model, in the learner", _text(figures["taught_mib"]), "MiB"),
        ("a version in the store", _mib(figures["version_bytes"]), "MiB"),
        ("a snapshot in the store", _mib(figures["snapshot_bytes"]), "MiB"),
    ]
    return Grid("constants (PostgreSQL and S3)", ("", "", ""), rows)


def _mib(size: float | None) -> str:
    return NOTHING if size is None else f"{size / KIB**2:.2f}"


def _text(value: float | None) -> str:
    if value is None:
        return NOTHING
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.1f}" if abs(value) >= 10 else f"{value:.3f}"
