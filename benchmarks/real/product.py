"""The service under test: it prepares recordings, trains with default options and predicts, through its API."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.real.peers import Peer
from benchmarks.real.rivals import Forecast
from benchmarks.workload import BenchError
from lipcore.data.metrics import LEVEL, quantile
from lipcore.data.samples import Samples
from lipserve import Client, Prediction
from lipserve.asking import Reading
from lipserve.states import SUCCEEDED
from service.cli.demo import ServiceProcess
from service.cli.simulate import write_recording
from service.datasets import store
from service.foundation.settings import Settings
from service.storage.storage import Storage

BATCH_ROWS = 500
"""Queries of one prediction request."""


@dataclass(frozen=True)
class Trained:
    """A trained version."""

    model: str
    version: int
    estimator: str
    """The chosen estimator."""
    seconds: float
    """Duration of the job."""
    peak_mb: int
    """Peak memory of the job's process."""


@dataclass(frozen=True)
class Bed:
    """A running service and its home."""

    client: Client
    home: Path

    def prepare(self, path: Path, reading: Reading) -> Samples:
        """Upload a recording and return its samples as prepared by the service."""
        dataset = self.client.upload(path, **reading)
        storage = Storage.open(Settings(home=self.home))
        try:
            return store.samples(storage.files, store.find(storage.database, dataset.id))
        finally:
            storage.database.close()

    def upload(self, name: str, samples: Samples) -> str:
        """Upload samples; return the id of the data set."""
        with TemporaryDirectory() as folder:
            path = Path(folder) / f"{name}.npz"
            write_recording(path, samples)
            return self.client.upload(path, units={"t": "s"}).id

    def train(self, model: str, datasets: Sequence[str], joint_types: Sequence[str], robot: str | None) -> Trained:
        """Train on data sets with default options; raise BenchError if the job fails."""
        queued = self.client.train(model, datasets, joint_types=joint_types, robot=robot)
        job = self.client.wait(queued.id)
        if job.state != SUCCEEDED or job.version is None or job.started_at is None or job.finished_at is None:
            raise BenchError(
                f"The training job has {job.state}: {job.error.message if job.error else 'no reason given'}"
            )
        spent = datetime.fromisoformat(job.finished_at) - datetime.fromisoformat(job.started_at)
        version = self.client.version(model, job.version)
        peak_mb = version.lineage["training_process"]["peak_memory_mb"]
        return Trained(model, job.version, version.estimator, spent.total_seconds(), peak_mb)

    def predict(self, trained: Trained, samples: Samples) -> Forecast:
        """Predict the torque along the motion, and the standard deviation equivalent to the 95 % interval."""
        found = []
        for part in samples.episodes():
            episode, history = samples.rows(part), None
            for start in range(0, len(episode), BATCH_ROWS):
                rows = episode.rows(slice(start, start + BATCH_ROWS))
                answer = self.client.predict(
                    trained.model, rows.q, rows.dq, rows.ddq, version=trained.version, t=rows.t, history=history
                )
                history = rows.t, rows.q, rows.dq
                found.append(forecast_of(answer))
        return Forecast(np.concatenate([each.mean for each in found]), np.concatenate([each.std for each in found]))


def forecast_of(answer: Prediction) -> Forecast:
    """Return the torque of an answer, and the standard deviation equivalent to its 95 % interval."""
    low, high = answer.interval(LEVEL)
    return Forecast(answer.tau, (high - low) / (2 * quantile(LEVEL)))


@contextmanager
def open_bed(jobs: int) -> Iterator[Bed]:
    """Start a service that trains at most `jobs` models at a time; stop it at the end."""
    with TemporaryDirectory(prefix="lipserve-bench-") as home:
        service = ServiceProcess(0, {"LIPSERVE_HOME": home, "LIPSERVE_TRAINING_WORKERS": str(jobs)})
        try:
            with Client(service.url) as client:
                service.wait_ready(client)
                yield Bed(client, Path(home))
        finally:
            service.stop()


PEER = Peer(
    needs="types of joints that slide; a URDF helps",
    friction="viscous, Coulomb, and by evidence of speed, load, position and play",
    parameters="standard deviations, all finite; unidentifiable ones are named",
    torque="95 % interval of each",
    code=(Bed.train, Bed.predict),
)
