"""The measured model, queries that are not training data, and a service that serves the model."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

import lipcore
from benchmarks.clients import Address
from lipcore.data.samples import Array, Samples
from lipcore.model.torque_model import TorqueModel
from lipcore.robots.library import ROBOTS, Robot, load_robot
from lipcore.robots.simulation import Simulation, simulate
from lipserve import Client
from lipserve.progress import follow
from lipserve.states import SUCCEEDED
from service.cli.demo import ServiceProcess, free_port
from service.cli.simulate import write_recording
from service.foundation.settings import Settings
from service.models import registry
from service.storage.database import Database
from service.storage.files import Files, new_id

MODEL = "bench"
TRAIN_SEED, QUERY_SEED = 1, 2
QUERY_SINUSOIDS = 100
"""Queries follow another trajectory of twice the bandwidth, as in the paper's tests."""
RANDOM_QUERIES = 500
"""Queries for a model without a known simulator."""


class BenchError(RuntimeError):
    """A step of the benchmark failed."""


@dataclass(frozen=True)
class Source:
    """Source of the model: a simulated stream to train on, or an existing folder.

    Attributes:
        fit: options of the training job.
        load: options of the job that runs while answers are timed.
    """

    robot: str = "panda"
    stream: Simulation = field(default_factory=Simulation)
    fit: Mapping[str, Any] = field(default_factory=dict)
    load: Mapping[str, Any] = field(
        default_factory=lambda: {"hyperparameter_samples": 300, "max_iterations": 10_000, "starts": 1}
    )
    folder: Path | None = None


@dataclass(frozen=True)
class Workload:
    """A model loaded in this process, and its queries.

    Attributes:
        queries: q, dq and ddq, (Q, 3, n).
        samples: the training samples, if known.
        robot: the simulator, if known.
    """

    folder: Path
    manifest: Mapping[str, Any]
    model: TorqueModel
    queries: Array
    samples: Samples | None
    robot: Robot | None

    @classmethod
    def load(cls, folder: Path, robot: Robot | None, samples: Samples | None, stream: Simulation) -> Workload:
        """Load the model in this process; queries follow another trajectory, or are random if the stream is unknown."""
        manifest = json.loads((folder / "manifest.json").read_bytes())
        model = lipcore.load(folder)
        model.warm_up()
        if samples is not None and robot is not None:
            unseen = simulate(robot, _unseen(stream), QUERY_SEED)
            queries = np.stack([unseen.q, unseen.dq, unseen.ddq], axis=1)
        else:
            queries = _random_queries(manifest["training_range"], RANDOM_QUERIES)
        return cls(folder, manifest, model, np.ascontiguousarray(queries), samples, robot)


@dataclass(frozen=True)
class Bed:
    """A running service with the model, its addresses (`grpc`: None without the extra) and its process id."""

    client: Client
    tcp: Address
    unix: Address
    grpc: tuple[str, int] | None
    dataset: str
    workload: Workload
    pid: int


@contextmanager
def open_bed(home: Path, source: Source, console: Console, settings: Mapping[str, str] | None = None) -> Iterator[Bed]:
    """Start a service in an empty `home` with the model, trained by a job or copied; load the model here too.

    settings: further environment variables of the service.
    """
    if source.folder is not None:
        _install(home, source.folder)
    unix = home / "lipserve.sock"
    env = {"LIPSERVE_HOME": str(home), "LIPSERVE_UDS": str(unix), "LIPSERVE_LOG_LEVEL": "warning"}
    env |= settings or {}
    calls = ("127.0.0.1", free_port()) if find_spec("grpc") is not None else None
    if calls is not None:
        env["LIPSERVE_GRPC_PORT"] = str(calls[1])
    service = ServiceProcess(0, env)
    try:
        with Client(service.url) as client:
            console.print(f"service ready after {service.wait_ready(client):.1f} s")
            robot = load_robot(source.robot)
            samples = simulate(robot, source.stream, TRAIN_SEED)
            dataset = _upload(client, samples, home / "stream.npz")
            if source.folder is None:
                workload = Workload.load(
                    _train(client, home, dataset, robot, source, console), robot, samples, source.stream
                )
            else:
                workload = Workload.load(source.folder, simulator(source.folder), None, source.stream)
            yield Bed(client, ("127.0.0.1", service.port), unix, calls, dataset, workload, service.process.pid)
    finally:
        service.stop()


def model_folder(name: str) -> Path:
    """Return the folder of a model's latest version in the home of the settings; raise NotFoundError."""
    settings = Settings()
    database = Database.of(settings)
    try:
        return Files.of(settings).version_folder(registry.find(database, name, None).folder)
    finally:
        database.close()


def _install(home: Path, folder: Path) -> None:
    """Publish a copy of a saved model in a home that no service uses yet."""
    database, files, name = Database(home), Files(home), new_id("mv")
    try:
        with files.new_version(name) as target:
            manifest = lipcore.copy_model(folder, target)
        with database.transaction() as session:
            registry.publish(session, MODEL, name, manifest, None)
    finally:
        database.close()


def _upload(client: Client, samples: Samples, path: Path) -> str:
    write_recording(path, samples)
    return client.upload(path).id


def _train(client: Client, home: Path, dataset: str, robot: Robot, source: Source, console: Console) -> Path:
    queued = client.train(MODEL, [dataset], "lip-chain", list(robot.joint_types), dict(source.fit))
    job = follow(client, queued, console)
    if job.state != SUCCEEDED:
        raise BenchError(f"The training job has {job.state}: {job.error.message if job.error else 'no error given'}")
    for folder in (home / "versions").iterdir():
        if json.loads((folder / "manifest.json").read_bytes())["lineage"].get("job") == job.id:
            return folder
    raise BenchError(f"No model in {home} was trained by job {job.id}.")


def _unseen(stream: Simulation) -> Simulation:
    return replace(stream, n_sinusoids=QUERY_SINUSOIDS)


def simulator(folder: Path) -> Robot | None:
    """Return the simulated robot with the model's joint names, if there is one."""
    names = tuple(json.loads((folder / "manifest.json").read_bytes())["joint_names"])
    found = next((name for name, source in ROBOTS.items() if source.free == names), None)
    return None if found is None else load_robot(found)


def _random_queries(ranges: Mapping[str, Mapping[str, list[float]]], count: int) -> Array:
    """Return random motions inside the range of the training samples, (count, 3, n)."""
    rng = np.random.default_rng(QUERY_SEED)
    low, high = (np.array([ranges[name][end] for name in ("q", "dq", "ddq")]) for end in ("min", "max"))
    motions: Array = low + (high - low) * rng.random((count, *low.shape))
    return motions
