"""Kills at random moments while batches come, and what the service knows afterwards."""

from __future__ import annotations

import os
import signal
import sqlite3
import time
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from threading import Timer
from types import TracebackType
from typing import Literal, Self

import numpy as np

from benchmarks.clients import BadAnswerError, HttpClient
from benchmarks.online.bed import Bed
from benchmarks.online.scene import rows_of
from benchmarks.online.sending import Ack, batch_request, send
from benchmarks.processes import PROC, levels
from benchmarks.workload import BenchError
from lipcore.data.samples import Array, Samples
from lipcore.model.torque_model import TorqueModel
from lipcore.online.learner import OnlineModel
from lipserve import Client
from service.cli.demo import ServiceProcess

Victim = Literal["service", "learner"]
MODEL, STREAM = "durable", "trials"
BATCHES, ROWS = 30, 10
"""Of a trial."""
LATE, TWICE = 0.2, 0.2
"""Shares of batches that are sent after a later one, and a second time."""
GAP = 0.02
"""Longest pause between two batches, s."""
SETTINGS = {"publish_every_s": 0.005, "max_snapshots": 4, "log_level": "error"}
"""Of the service: revisions and snapshots follow each other fast enough to be hit."""
DATABASE = "lipserve.sqlite3"
_RECOVERY = 60.0


@dataclass
class Tally:
    """Of all trials.

    kills: by victim; unanswered: batches that were on their way at a kill; repeated, late: that were sent twice, or
    after a later one, on purpose; lost: acknowledged, but unknown when sent again after the kill; twice: logged more
    than once; refused: rows that were not learnt; largest: of the relative differences of served torques from those of
    a model that learnt all rows at once; one_batch: the least that one batch more or less would make of it.
    """

    kills: dict[Victim, int] = field(default_factory=lambda: {"service": 0, "learner": 0})
    batches: int = 0
    unanswered: int = 0
    repeated: int = 0
    late: int = 0
    lost: int = 0
    twice: int = 0
    refused: int = 0
    largest: float = 0.0
    one_batch: float = 0.0


class Trials:
    """Trials on one home, one after the other; the service runs while this is entered.

    samples: what is sent, in batches of ROWS numbered from 0 on; base: the served model as trained; queries: where
    torques are compared.
    """

    def __init__(self, home: Path, base: TorqueModel, samples: Samples, queries: Samples, seed: int) -> None:
        self.home, self.base, self.samples, self.queries = home, base, samples, queries
        self.rng, self.tally = np.random.default_rng(seed), Tally()

    def __enter__(self) -> Self:
        self._start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bed.client.close()
        self._service.stop()

    def trial(self, victim: Victim, batches: int = BATCHES) -> None:
        """Send the next batches, kill somewhere among them, send again what was not acknowledged, and compare.

        Raise BenchError where the service does not recover.
        """
        tally, acks = self.tally, dict[int, Ack]()
        plan = self._plan(tally.batches, batches)
        killer = Timer(float(self.rng.uniform(0, GAP * len(plan))), self._kill, [victim])
        killer.start()
        left = self._send(plan, acks)
        killer.join()
        tally.kills[victim] += 1
        tally.batches += batches
        if victim == "service":
            self._service.process.wait()
            self._bed.client.close()
            self._start()
        acknowledged = sorted(acks)
        tally.unanswered += bool(left)
        if rest := self._send(left, acks):
            raise BenchError(f"batch {rest[0]} was not acknowledged after the {victim} was killed")
        self._send_again(acknowledged)
        tally.refused += sum(ack.rows - ack.accepted for ack in acks.values())
        tally.twice += max(0, self._logged() - tally.batches)
        self._compare(max(ack.revision for ack in acks.values()))

    def weigh(self, batches: int = 5) -> None:
        """Find out what difference one batch more or less would make."""
        known, rest = self._learnt(), self.rng.choice(self.tally.batches, batches).tolist()
        learnt = self._tau(known.model())
        more = (self._tau(known.learn(rows_of(self._batch(sequence))).model()) for sequence in rest)
        self.tally.one_batch = min(_difference(tau, learnt) for tau in more)

    def _plan(self, first: int, count: int) -> list[int]:
        """Sequences as they are sent: most in order, some after their successor, some twice."""
        plan = list(range(first, first + count))
        for place in np.flatnonzero(self.rng.random(count - 1) < LATE).tolist():
            plan[place], plan[place + 1] = plan[place + 1], plan[place]
        self.tally.late += sum(plan[place] > plan[place + 1] for place in range(count - 1))
        again = self.rng.random(count) < TWICE
        self.tally.repeated += int(again.sum())
        return [sequence for sequence, twice in zip(plan, again, strict=True) for _ in range(1 + twice)]

    def _send(self, plan: list[int], acks: dict[int, Ack]) -> list[int]:
        """Send batches until the service is gone; return those that it has not acknowledged."""
        for place, sequence in enumerate(plan):
            try:
                with HttpClient(self._bed.tcp) as client:
                    acks[sequence] = send(client, self._request(sequence))
            except (BadAnswerError, OSError):
                return plan[place:]
            time.sleep(float(self.rng.uniform(0, GAP)))
        return []

    def _send_again(self, acknowledged: list[int]) -> None:
        """Send what was acknowledged before the kill: the service must know all of it."""
        with HttpClient(self._bed.tcp) as client:
            for sequence in acknowledged:
                self.tally.lost += not send(client, self._request(sequence)).duplicate

    def _compare(self, revision: int) -> None:
        """Wait until all is learnt, and compare torques with those of a model that learnt it at once."""
        queries = self.queries
        motion = np.stack([queries.q[0], queries.dq[0], queries.ddq[0]])
        self._bed.wait_learnt(MODEL, motion, revision, _RECOVERY)
        served = self._bed.predict(MODEL, queries)[0]
        self.tally.largest = max(self.tally.largest, _difference(served, self._tau(self._learnt().model())))

    def _learnt(self) -> OnlineModel:
        """The model after all batches so far, learnt in one go."""
        return OnlineModel.start(self.base).learn(rows_of(self.samples.rows(slice(0, ROWS * self.tally.batches))))

    def _tau(self, model: TorqueModel) -> Array:
        return model.predict(self.queries.q, self.queries.dq, self.queries.ddq).tau

    def _batch(self, sequence: int) -> Samples:
        return self.samples.rows(slice(ROWS * sequence, ROWS * (sequence + 1)))

    def _request(self, sequence: int) -> bytes:
        return batch_request(MODEL, STREAM, sequence, self._batch(sequence))

    def _logged(self) -> int:
        """How many batches the log in the database has."""
        address = f"file:{self.home / DATABASE}?mode=ro"
        with closing(sqlite3.connect(address, uri=True)) as database:
            query = "SELECT COUNT(*) FROM events WHERE model = ? AND kind = 'batch' AND NOT void"
            return int(database.execute(query, (MODEL,)).fetchone()[0])

    def _start(self) -> None:
        settings = {"home": self.home, **SETTINGS}
        self._service = ServiceProcess(0, {f"LIPSERVE_{name.upper()}": str(each) for name, each in settings.items()})
        self._bed = Bed(("127.0.0.1", self._service.port), self._service.process.pid, Client(self._service.url))
        try:
            self._service.wait_ready(self._bed.client)
        except BaseException:
            self._service.stop()
            raise

    def _kill(self, victim: Victim) -> None:
        if victim == "service":
            self._service.process.kill()
            return
        end = time.monotonic() + _RECOVERY
        while not (found := learners(self._service.process.pid)) and time.monotonic() < end:
            time.sleep(0.001)
        for pid in found:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


def learners(service: int) -> list[int]:
    """Process ids of what learns and weighs for a service, its only spawned children while nothing is trained."""
    found = []
    for child in (each for level in levels(service)[1:2] for each in level):
        with suppress(FileNotFoundError, ProcessLookupError):
            if "spawn_main" in (PROC / str(child) / "cmdline").read_text():
                found.append(child)
    return found


def _difference(one: Array, other: Array) -> float:
    """Largest difference, relative to the largest of the others."""
    return float(np.abs(one - other).max() / np.abs(other).max())
