"""Kills and restarts under load: a worker during a job, a service and its learner, PostgreSQL."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np
from rich.console import Console

from benchmarks.clients import BadAnswerError, HttpClient
from benchmarks.latency.table import Grid
from benchmarks.latency.targets import Target
from benchmarks.online.sending import Ack, batch_request, send
from benchmarks.online.trials import learners
from benchmarks.scale import streams
from benchmarks.scale.engines import Engines, eventually, ready
from benchmarks.scale.part import Part
from benchmarks.scale.replicas import LEARNING, MODEL
from benchmarks.workload import BenchError
from lipcore.data.samples import Samples
from lipserve import ApiError, Client
from lipserve.states import ACTIVE, SUCCEEDED
from service.cli.demo import ServiceProcess

NAME = "faults"
STREAM = "faults"
BATCHES, ROWS = 40, 10
"""Batches of a trial, and rows of a batch."""
MAX_GAP_S = 0.02
"""Max pause between two batches."""
JOB = {"hyperparameter_samples": 100, "posterior_samples": 200, "max_iterations": 150, "starts": 1}
"""Options of a job that is long enough to be interrupted."""
SETTINGS = {"publish_every_s": 0.02, "replica_lost_s": 3.0, "log_level": "critical"}
"""Settings of the services; the errors provoked here are not logged."""
_TIMEOUT_S = 120.0


@dataclass
class Tally:
    """Counts of faults of one kind.

    Attributes:
        name: kind of the fault.
        faults: number of faults.
        acknowledged: acknowledged batches, or queued jobs.
        refused: failed requests, which the client repeated.
        lost: acknowledged, but unknown afterwards.
        twice: stored more than once.
        recovered: faults after which all services continued and had identical answers.
        longest: longest time without an acknowledgement, s.
    """

    name: str
    faults: int = 0
    acknowledged: int = 0
    refused: int = 0
    lost: int = 0
    twice: int = 0
    recovered: int = 0
    longest: float = 0.0


class Load:
    """A client that sends batches to two services in turn, and repeats those without an answer."""

    def __init__(self, engines: Engines, samples: Samples, seed: int) -> None:
        self.engines, self.samples, self.rng = engines, samples, np.random.default_rng(seed)
        self.services = [self._start(), self._start()]
        self.sent, self.revision = 0, 0
        with ready(self.services[0]) as client, ready(self.services[1]):
            client.put_learning(MODEL, LEARNING)

    def batches(self, count: int, tally: Tally) -> None:
        """Send the next batches until each is acknowledged; raise BenchError after _TIMEOUT_S."""
        last = time.monotonic()
        for sequence in range(self.sent, self.sent + count):
            ack = self._send(sequence, tally)
            tally.acknowledged += 1
            tally.longest = max(tally.longest, time.monotonic() - last)
            last = time.monotonic()
            self.revision = max(self.revision, ack.revision)
            time.sleep(float(self.rng.uniform(0, MAX_GAP_S)))
        self.sent += count

    def count_losses(self, tally: Tally) -> None:
        """Send all acknowledged batches again and count logged ones, to find lost and duplicate batches."""
        with HttpClient(("127.0.0.1", self.services[0].port)) as http:
            known = sum(send(http, self._request(sequence)).duplicate for sequence in range(self.sent))
        query = "SELECT count(*) FROM events WHERE model = %s AND stream_id = %s AND kind = 'batch' AND NOT void"
        logged = int(self.engines.postgres.ask(query, self.engines.database, MODEL, STREAM)[0][0])
        tally.lost += self.sent - known
        tally.twice += max(0, logged - self.sent)

    def is_same(self) -> bool:
        """Wait until both services have learnt all acknowledged batches; return whether their answers are identical."""
        motion = self.samples.rows(slice(0, 50))
        found = []
        for service in self.services:
            with Client(service.url) as client:

                def look(client: Client = client) -> bool:
                    with suppress(ApiError, OSError):
                        answer = client.predict(MODEL, motion.q[0], motion.dq[0], motion.ddq[0])
                        return answer.revision >= self.revision
                    return False

                eventually(look, f"revision {self.revision} at {service.url}", _TIMEOUT_S)
                answer = client.predict(MODEL, motion.q, motion.dq, motion.ddq)
                found.append((answer.revision, answer.tau.tobytes(), np.asarray(answer.tau_std).tobytes()))
        return found[0] == found[1]

    def replace(self, place: int) -> None:
        """Start a service in the place of a killed one."""
        self.services[place].process.wait()
        self.services[place] = self._start()
        ready(self.services[place]).close()

    def stop(self) -> None:
        """Stop both services."""
        for service in self.services:
            service.stop()

    def _start(self) -> ServiceProcess:
        return self.engines.service(SETTINGS)

    def _send(self, sequence: int, tally: Tally) -> Ack:
        request, attempt, deadline = self._request(sequence), sequence, time.monotonic() + _TIMEOUT_S
        while time.monotonic() < deadline:
            try:
                with HttpClient(("127.0.0.1", self.services[attempt % 2].port)) as http:
                    return send(http, request)
            except (BadAnswerError, OSError):
                tally.refused += 1
                attempt += 1
                time.sleep(MAX_GAP_S)
        raise BenchError(f"Batch {sequence} was not acknowledged within {_TIMEOUT_S:g} s.")

    def _request(self, sequence: int) -> bytes:
        return batch_request(MODEL, STREAM, sequence, self.samples.rows(slice(ROWS * sequence, ROWS * (sequence + 1))))


def run(engines: Engines, faults: int, seed: int, console: Console) -> Part:
    """Inject `faults` faults of each kind."""
    rng = np.random.default_rng(seed)
    load = Load(engines, streams.stream(4 * (faults + 1) * BATCHES * ROWS, seed + 8), seed)
    tallies = []
    for name, strike in (
        ("service killed while it learns", lambda: _kill_service(load, rng)),
        ("learner killed while it learns", lambda: _kill_learner(load, rng)),
        ("PostgreSQL restarted while services learn", lambda: _restart_database(load, rng)),
    ):
        tallies.append(_trials(load, Tally(name), strike, faults, console))
    load.stop()
    tallies.append(_workers(engines, faults, seed, console))
    columns = ("", "faults", "acknowledged", "failed requests", "lost", "twice", "recovered", "longest pause s")
    rows = []
    for each in tallies:
        counts = (each.faults, each.acknowledged, each.refused, each.lost, each.twice, each.recovered)
        rows.append((each.name, *map(str, counts), f"{each.longest:.1f}"))
    targets = [
        Target("acknowledged and lost", sum(each.lost for each in tallies), "", "≤", 0),
        Target("done twice", sum(each.twice for each in tallies), "", "≤", 0),
        Target("faults without recovery", sum(each.faults - each.recovered for each in tallies), "", "≤", 0),
    ]
    figures = {"tallies": [asdict(each) for each in tallies]}
    return Part(NAME, figures, [Grid("faults under load", columns, rows)], targets)


def _trials(load: Load, tally: Tally, strike: Callable[[], Callable[[], None]], count: int, console: Console) -> Tally:
    """Call `strike` during the batches of each trial; it returns a function that repairs the fault."""
    for _ in range(count):
        mend: list[Callable[[], None]] = []
        delay = float(load.rng.uniform(0.1, 0.5 * MAX_GAP_S * BATCHES))
        striker = threading.Timer(delay, lambda mend=mend: mend.append(strike()))
        striker.start()
        load.batches(BATCHES, tally)
        striker.join()
        for each in mend:
            each()
        load.batches(BATCHES // 4, tally)
        tally.faults += 1
        tally.recovered += load.is_same()
        console.print(f"{tally.name}: {tally.recovered} of {tally.faults} recovered", highlight=False)
    load.count_losses(tally)
    return tally


def _kill_service(load: Load, rng: np.random.Generator) -> Callable[[], None]:
    place = int(rng.integers(2))
    load.services[place].process.kill()
    return lambda: load.replace(place)


def _kill_learner(load: Load, rng: np.random.Generator) -> Callable[[], None]:
    for pid in learners(load.services[int(rng.integers(2))].process.pid):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return lambda: None


def _restart_database(load: Load, _: np.random.Generator) -> Callable[[], None]:
    load.engines.postgres.restart()
    return lambda: None


def _workers(engines: Engines, faults: int, seed: int, console: Console) -> Tally:
    """Kill the worker that runs a job; the second worker has to finish it."""
    tally = Tally("worker killed while it runs a job")
    service = engines.service(SETTINGS, cluster=True)
    workers = [engines.worker(), engines.worker()]
    with ready(service) as client:
        engines.wait_workers(len(workers))
        path = engines.folder / "killed.parquet"
        streams.write(path, streams.stream(400, seed + 9, rate=10.0))
        dataset = client.upload(path, joint_names=streams.robot().joint_names).id
        for number in range(faults):
            name = client.train(f"job-{number}", [dataset], "lip-chain", list(streams.robot().joint_types), JOB).id
            tally.acknowledged += 1
            eventually(partial(_iterates, client, name), "the first iteration", _TIMEOUT_S)
            busy = next(place for place, worker in enumerate(workers) if learners(worker.pid))
            began = time.monotonic()
            workers[busy].kill()
            workers[busy].wait()
            tally.faults += 1
            workers[busy] = engines.worker()
            eventually(partial(_ended, client, name), "the end of the job", _TIMEOUT_S)
            tally.longest = max(tally.longest, time.monotonic() - began)
            tally.recovered += client.job(name).state == SUCCEEDED
            versions = client.model(f"job-{number}").versions if client.job(name).state == SUCCEEDED else []
            tally.lost += not versions
            tally.twice += max(0, len(versions) - 1)
            engines.wait_workers(len(workers))
            console.print(f"{tally.name}: {tally.recovered} of {tally.faults} recovered", highlight=False)
    service.stop()
    for worker in workers:
        worker.terminate()
        worker.wait(30)
    return tally


def _iterates(client: Client, job: str) -> bool:
    return client.job(job).progress.iteration > 0


def _ended(client: Client, job: str) -> bool:
    return client.job(job).state not in ACTIVE
