"""Trials that kill a service or its learner while it learns, and check its state afterwards."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import time
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from threading import Timer
from types import TracebackType
from typing import Any, Literal, Self

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
"""Batches of a trial, and rows of a batch."""
LATE_SHARE, TWICE_SHARE = 0.2, 0.2
"""Shares of batches that are sent after a later one, and twice."""
MAX_GAP_S = 0.02
"""Max pause between two batches."""
SETTINGS = {"publish_every_s": 0.005, "max_snapshots": 4, "log_level": "error"}
"""Settings of the service; revisions and snapshots are so frequent that kills interrupt them."""
DATABASE = "lipserve.sqlite3"
_RECOVERY_TIMEOUT_S = 60.0


@dataclass
class Tally:
    """Counts of all trials.

    Attributes:
        kills: kills by victim.
        batches: batches sent.
        unanswered: batches without an answer at a kill.
        repeated: batches sent twice on purpose.
        late: batches sent after a later one on purpose.
        lost: acknowledged batches that the service no longer knew after the kill.
        twice: batches logged more than once.
        refused: rows not learnt.
        largest: largest relative difference of served torques from a model that learnt all rows at once.
        one_batch: smallest such difference if one batch is learnt again.
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

    def write(self, path: Path, targets: list[dict[str, Any]]) -> None:
        """Write all counts as JSON."""
        path.write_text(json.dumps({**asdict(self), "targets": targets}, indent=2) + "\n")


class Trials:
    """A context manager that runs a service, for trials one after the other on one home.

    Attributes:
        home: home of the service.
        base: the served model as trained.
        samples: samples to send in batches of ROWS, with sequences from 0.
        queries: states at which torques are compared.
        rng: source of random numbers.
        tally: counts of all trials.
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
        """Send the next batches, kill the victim meanwhile, send the rest and compare.

        Raises:
            BenchError: The service does not recover.
        """
        tally, acks = self.tally, dict[int, Ack]()
        plan = self._plan(tally.batches, batches)
        killer = Timer(float(self.rng.uniform(0, MAX_GAP_S * len(plan))), self._kill, [victim])
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
            raise BenchError(f"Batch {rest[0]} was not acknowledged after the {victim} was killed.")
        self._send_again(acknowledged)
        tally.refused += sum(ack.rows - ack.accepted for ack in acks.values())
        tally.twice += max(0, self._logged() - tally.batches)
        self._compare(max(ack.revision for ack in acks.values()))

    def measure_one_batch(self, batches: int = 5) -> None:
        """Measure the difference that one batch more would make."""
        known, rest = self._learnt(), self.rng.choice(self.tally.batches, batches).tolist()
        learnt = self._tau(known.model())
        more = (self._tau(known.learn(rows_of(self._batch(sequence))).model()) for sequence in rest)
        self.tally.one_batch = min(_difference(tau, learnt) for tau in more)

    def _plan(self, first: int, count: int) -> list[int]:
        """Return the sequences in the order of sending: some after their successor, some twice."""
        plan = list(range(first, first + count))
        for place in np.flatnonzero(self.rng.random(count - 1) < LATE_SHARE).tolist():
            plan[place], plan[place + 1] = plan[place + 1], plan[place]
        self.tally.late += sum(plan[place] > plan[place + 1] for place in range(count - 1))
        again = self.rng.random(count) < TWICE_SHARE
        self.tally.repeated += int(again.sum())
        return [sequence for sequence, twice in zip(plan, again, strict=True) for _ in range(1 + twice)]

    def _send(self, plan: list[int], acks: dict[int, Ack]) -> list[int]:
        """Send batches until the service stops answering; return those that it has not acknowledged."""
        for place, sequence in enumerate(plan):
            try:
                with HttpClient(self._bed.tcp) as client:
                    acks[sequence] = send(client, self._request(sequence))
            except (BadAnswerError, OSError):
                return plan[place:]
            time.sleep(float(self.rng.uniform(0, MAX_GAP_S)))
        return []

    def _send_again(self, acknowledged: list[int]) -> None:
        """Send batches that were acknowledged before the kill; count those that the service does not know."""
        with HttpClient(self._bed.tcp) as client:
            for sequence in acknowledged:
                self.tally.lost += not send(client, self._request(sequence)).duplicate

    def _compare(self, revision: int) -> None:
        """Wait until all rows are learnt; compare torques with those of a model that learnt them at once."""
        queries = self.queries
        motion = np.stack([queries.q[0], queries.dq[0], queries.ddq[0]])
        self._bed.wait_learnt(MODEL, motion, revision, _RECOVERY_TIMEOUT_S)
        served = self._bed.predict(MODEL, queries)[0]
        self.tally.largest = max(self.tally.largest, _difference(served, self._tau(self._learnt().model())))

    def _learnt(self) -> OnlineModel:
        """Return the model that learnt all batches so far at once."""
        return OnlineModel.start(self.base).learn(rows_of(self.samples.rows(slice(0, ROWS * self.tally.batches))))

    def _tau(self, model: TorqueModel) -> Array:
        return model.predict(self.queries.q, self.queries.dq, self.queries.ddq).tau

    def _batch(self, sequence: int) -> Samples:
        return self.samples.rows(slice(ROWS * sequence, ROWS * (sequence + 1)))

    def _request(self, sequence: int) -> bytes:
        return batch_request(MODEL, STREAM, sequence, self._batch(sequence))

    def _logged(self) -> int:
        """Return the number of batches in the log of the database."""
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
        end = time.monotonic() + _RECOVERY_TIMEOUT_S
        while not (found := learners(self._service.process.pid)) and time.monotonic() < end:
            time.sleep(0.001)
        for pid in found:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


def learners(service: int) -> list[int]:
    """Return the process ids of the learner and the weigher, the only spawned children if no job runs."""
    found = []
    for child in (each for level in levels(service)[1:2] for each in level):
        with suppress(FileNotFoundError, ProcessLookupError):
            if "spawn_main" in (PROC / str(child) / "cmdline").read_text():
                found.append(child)
    return found


def _difference(one: Array, other: Array) -> float:
    """Return the largest difference, relative to the largest value of `other`."""
    return float(np.abs(one - other).max() / np.abs(other).max())
