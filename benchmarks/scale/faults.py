"""Kills and restarts under load: a worker in the middle of a job, a service in the middle of batches, PostgreSQL."""

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
"""Of a trial."""
GAP = 0.02
"""Longest pause between two batches, s."""
JOB = {"hyperparameter_samples": 100, "posterior_samples": 200, "max_iterations": 150, "starts": 1}
"""A job that runs long enough to be hit."""
SETTINGS = {"publish_every_s": 0.02, "replica_lost_s": 3.0, "log_level": "critical"}
"""Errors are made here on purpose: what they say of them would only hide the tally."""
_PATIENCE = 120.0


@dataclass
class Tally:
    """Of faults of one kind.

    acknowledged: batches, or jobs that were queued; refused: answers that were none, after which the client tried
    again; lost: acknowledged, but unknown afterwards; twice: there more often than once; recovered: faults after which
    everything went on by itself and all services answered with the same bits; longest: s without an acknowledgement.
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
    """A client of two services that sends batches to them in turn, and again where one does not answer."""

    def __init__(self, engines: Engines, samples: Samples, seed: int) -> None:
        self.engines, self.samples, self.rng = engines, samples, np.random.default_rng(seed)
        self.services = [self._start(), self._start()]
        self.sent, self.revision = 0, 0
        with ready(self.services[0]) as client, ready(self.services[1]):
            client.put_learning(MODEL, LEARNING)

    def batches(self, count: int, tally: Tally) -> None:
        """Send the next batches until each is acknowledged; raise BenchError where one is not within two minutes."""
        last = time.monotonic()
        for sequence in range(self.sent, self.sent + count):
            ack = self._send(sequence, tally)
            tally.acknowledged += 1
            tally.longest = max(tally.longest, time.monotonic() - last)
            last = time.monotonic()
            self.revision = max(self.revision, ack.revision)
            time.sleep(float(self.rng.uniform(0, GAP)))
        self.sent += count

    def judge(self, tally: Tally) -> None:
        """Ask for every batch that was acknowledged, count those logged, and compare the answers of both services."""
        with HttpClient(("127.0.0.1", self.services[0].port)) as http:
            known = sum(send(http, self._request(sequence)).duplicate for sequence in range(self.sent))
        query = "SELECT count(*) FROM events WHERE model = %s AND stream_id = %s AND kind = 'batch' AND NOT void"
        logged = int(self.engines.postgres.ask(query, self.engines.database, MODEL, STREAM)[0][0])
        tally.lost += self.sent - known
        tally.twice += max(0, logged - self.sent)

    def same(self) -> bool:
        """Wait until both services answer with all that was acknowledged; return whether their answers are the same."""
        motion = self.samples.rows(slice(0, 50))
        found = []
        for service in self.services:
            with Client(service.url) as client:

                def look(client: Client = client) -> bool:
                    with suppress(ApiError, OSError):
                        answer = client.predict(MODEL, motion.q[0], motion.dq[0], motion.ddq[0])
                        return answer.revision >= self.revision
                    return False

                eventually(look, f"revision {self.revision} at {service.url}", _PATIENCE)
                answer = client.predict(MODEL, motion.q, motion.dq, motion.ddq)
                found.append((answer.revision, answer.tau.tobytes(), np.asarray(answer.tau_std).tobytes()))
        return found[0] == found[1]

    def replace(self, place: int) -> None:
        """Start another service where one was killed."""
        self.services[place].process.wait()
        self.services[place] = self._start()
        ready(self.services[place]).close()

    def stop(self) -> None:
        """End both services."""
        for service in self.services:
            service.stop()

    def _start(self) -> ServiceProcess:
        return self.engines.service(SETTINGS)

    def _send(self, sequence: int, tally: Tally) -> Ack:
        request, attempt, deadline = self._request(sequence), sequence, time.monotonic() + _PATIENCE
        while time.monotonic() < deadline:
            try:
                with HttpClient(("127.0.0.1", self.services[attempt % 2].port)) as http:
                    return send(http, request)
            except (BadAnswerError, OSError):
                tally.refused += 1
                attempt += 1
                time.sleep(GAP)
        raise BenchError(f"batch {sequence} was not acknowledged within {_PATIENCE:g} s")

    def _request(self, sequence: int) -> bytes:
        return batch_request(MODEL, STREAM, sequence, self.samples.rows(slice(ROWS * sequence, ROWS * (sequence + 1))))


def run(engines: Engines, faults: int, seed: int, console: Console) -> Part:
    """So many faults of each kind."""
    rng = np.random.default_rng(seed)
    load = Load(engines, streams.stream(4 * (faults + 1) * BATCHES * ROWS, seed + 8), seed)
    tallies = []
    for name, strike in (
        ("a service killed while batches come", lambda: _kill_service(load, rng)),
        ("a learner killed while batches come", lambda: _kill_learner(load, rng)),
        ("PostgreSQL restarted while batches come", lambda: _restart_database(load, rng)),
    ):
        tallies.append(_trials(load, Tally(name), strike, faults, console))
    load.stop()
    tallies.append(_workers(engines, faults, seed, console))
    columns = ("", "faults", "acknowledged", "refused meanwhile", "lost", "twice", "recovered", "longest pause s")
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
    """Strike somewhere among the batches of each trial; `strike` returns what mends it afterwards."""
    for _ in range(count):
        mend: list[Callable[[], None]] = []
        delay = float(load.rng.uniform(0.1, 0.5 * GAP * BATCHES))
        striker = threading.Timer(delay, lambda mend=mend: mend.append(strike()))
        striker.start()
        load.batches(BATCHES, tally)
        striker.join()
        for each in mend:
            each()
        load.batches(BATCHES // 4, tally)
        tally.faults += 1
        tally.recovered += load.same()
        console.print(f"{tally.name}: {tally.recovered} of {tally.faults} recovered", highlight=False)
    load.judge(tally)
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
    """Kill the worker that runs a job; another one of two has to finish it."""
    tally = Tally("a worker killed while it runs a job")
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
            eventually(partial(_iterates, client, name), "the first iteration", _PATIENCE)
            busy = next(place for place, worker in enumerate(workers) if learners(worker.pid))
            began = time.monotonic()
            workers[busy].kill()
            workers[busy].wait()
            tally.faults += 1
            workers[busy] = engines.worker()
            eventually(partial(_ended, client, name), "the end of the job", _PATIENCE)
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
