"""The load benchmark from options to results."""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

import lipcore
from benchmarks import facts
from benchmarks.online.bed import Bed, install, serving, train
from benchmarks.online.running import FIT
from benchmarks.online.scene import Scene
from benchmarks.soak import accounting, clients
from benchmarks.soak.accounting import Account
from benchmarks.soak.clients import PROCESSES, Mix, Work
from benchmarks.soak.connections import BATCH_PERIOD, BATCH_ROWS, STEADY, TAUGHT, Expected, Log
from benchmarks.soak.resources import ResourceWatch, series
from benchmarks.timing import Timing
from lipcore.data.samples import Samples
from lipcore.model.torque_model import TorqueModel
from service.contract.observations import LearningOptions

KINDS = ("predict", "stream", "observe", "upload")
QUERIES, UPLOADED_ROWS = 200, 300
"""Number of queries; rows of an uploaded recording."""
OBSERVED_RATE = 50.0
"""Rate of the observed streams, Hz: half a second a batch."""
LEARNING = LearningOptions(on_change="learn", contact_threshold=100.0, auto_refresh=False, auto_promote=False)
"""All rows are learnt, so that the benchmark can compute the expected model."""


@dataclass(frozen=True)
class Options:
    """Scope of the load.

    Attributes:
        connections: simultaneous connections.
        seconds: duration.
        pause: wait between an answer and the next request, s.
        robot: robot of the motion.
        seed: seed of the motion.
        fit: fit options of the model.
    """

    connections: int = 64
    seconds: float = 120.0
    pause: float = 0.02
    robot: str = "panda"
    seed: int = 0
    fit: Mapping[str, Any] = field(default_factory=lambda: dict(FIT))


@dataclass
class Results:
    """All figures of the load.

    Attributes:
        facts: machine and packages.
        model: the served model.
        mix: connections of each kind.
        seconds: duration of the load.
        timings: duration of exchanges, by kind.
        errors: count of each error, by kind.
        service: memory of the service every second, MiB.
        children: memory of its learner every second, MiB.
        before: account before the restart of the service.
        after: account after the restart.
    """

    facts: dict[str, str]
    model: dict[str, str]
    mix: Mix
    seconds: float
    timings: dict[str, Timing] = field(default_factory=dict)
    errors: dict[str, Counter[str]] = field(default_factory=dict)
    service: list[float] = field(default_factory=list)
    children: list[float] = field(default_factory=list)
    before: Account = field(default_factory=Account)
    after: Account = field(default_factory=Account)

    @property
    def failed(self) -> int:
        """Number of failed exchanges."""
        return sum(sum(found.values()) for found in self.errors.values())

    def write(self, path: Path, targets: list[dict[str, Any]]) -> None:
        """Write all figures as JSON."""
        errors = {kind: dict(found) for kind, found in self.errors.items()}
        whole = replace(self, errors={})  # asdict does not convert Counters
        path.write_text(json.dumps({**asdict(whole), "errors": errors, "targets": targets}, indent=2) + "\n")


def run(options: Options, console: Console) -> Results:
    """Run the load and count writes; raise BenchError if a step fails."""
    scene, mix = Scene(options.robot, seed=options.seed), Mix.of(options.connections)
    machine = facts.machine()
    with tempfile.TemporaryDirectory(prefix="lipserve-bench-") as folder:
        home = Path(folder)
        console.print(f"training a model of {options.robot}", highlight=False)
        base, seconds = train(scene.history(80.0, 10.0), scene.arm.joint_types, options.fit)
        manifest = lipcore.save(base, home / "model")
        install(home / "home", home / "model", {STEADY: LEARNING, TAUGHT: LEARNING}, base.n_joints)
        results = Results(machine, facts.model(manifest, f"trained here in {seconds:.0f} s"), mix, options.seconds)
        observed, queries = _observed(scene, options, mix.observe), scene.unseen(0.0)
        with serving(home / "home") as bed:
            console.print(f"{mix.total} connections for {options.seconds:g} s", highlight=False)
            logs = _load(bed, base, options, mix, observed, queries, scene, results)
            results.before = Account.of(logs)
            console.print("counting stored writes", highlight=False)
            accounting.check(results.before, logs, bed.client)
            accounting.compare(results.before, logs, observed, base, queries, bed)
        with serving(home / "home") as bed:
            console.print("counting again after a restart", highlight=False)
            results.after = Account.of(logs)
            accounting.check(results.after, logs, bed.client)
            accounting.send_again(results.after, logs, observed, bed)
            accounting.compare(results.after, logs, observed, base, queries, bed)
    return results


def _load(
    bed: Bed,
    base: TorqueModel,
    options: Options,
    mix: Mix,
    observed: dict[int, Samples],
    queries: Samples,
    scene: Scene,
    results: Results,
) -> list[Log]:
    asked = queries.rows(slice(0, QUERIES))
    tau = base.predict(asked.q, asked.dq, asked.ddq).tau
    expected = Expected(asked.q, asked.dq, asked.ddq, tau)
    recording = scene.history(UPLOADED_ROWS / 10.0, 10.0)
    parts = [clients.share(each, PROCESSES) for each in (mix.predict, mix.stream, mix.observe, mix.upload)]
    works, first = [], 0
    for number in range(PROCESSES):
        part = Mix(*(each[number] for each in parts))
        mine = dict(list(observed.items())[first : first + part.observe])
        first += part.observe
        url = bed.client.url
        works.append(Work(bed.tcp, url, part, 1000 * number, options.seconds, options.pause, expected, recording, mine))
    with ResourceWatch(bed.pid) as watch:
        logs = clients.run(works)
    results.service, results.children = (series(watch.looks, name) for name in ("service", "learner"))
    for kind in KINDS:
        of_kind = [log for log in logs if log.kind == kind]
        times = [time for log in of_kind for time in log.times]
        if times:
            results.timings[kind] = Timing.of(np.array(times))
        results.errors[kind] = sum((log.errors for log in of_kind), Counter())
    return logs


def _observed(scene: Scene, options: Options, streams: int) -> dict[int, Samples]:
    """Return the samples of each observing connection, by its number; more than it can send."""
    batches = int(options.seconds / BATCH_PERIOD) + 2
    long = scene.more(streams * batches * BATCH_ROWS / OBSERVED_RATE)
    every = round(scene.rate / OBSERVED_RATE)
    rows = long.rows(slice(0, None, every))
    size = batches * BATCH_ROWS
    return {number: rows.rows(slice(number * size, (number + 1) * size)) for number in range(streams)}
