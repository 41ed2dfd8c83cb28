"""A service of the benchmark that serves copies of a trained model."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import lipcore
from benchmarks.clients import HttpClient, post
from benchmarks.workload import BenchError
from lipcore.data.samples import Array, Samples
from lipcore.model.torque_model import TorqueModel
from lipserve import Client
from service.cli.demo import ServiceProcess
from service.contract.observations import LearningOptions
from service.learning.owner import set_options
from service.models import registry
from service.storage.database import Database
from service.storage.files import Files, new_id

CAUGHT_UP_SECONDS = 300.0
"""Max wait until all acknowledged batches are learnt."""
_POLL_S = 0.02


@dataclass(frozen=True)
class Bed:
    """A running service, its address and its process id."""

    tcp: tuple[str, int]
    pid: int
    client: Client

    def wait_learnt(self, model: str, motion: Array, revision: int, seconds: float = CAUGHT_UP_SECONDS) -> int:
        """Wait until answers to a motion, (3, n), have a revision; return the time (`time.monotonic_ns`).

        Raises:
            BenchError: The revision did not come within `seconds`.
        """
        end = time.monotonic() + seconds
        with HttpClient(self.tcp) as client:
            request = _query(model, motion)
            while (found := json.loads(client.ask(request))["revision"]) < revision:
                if time.monotonic() > end:
                    raise BenchError(f"Model {model} has revision {found} after {seconds:g} s, expected {revision}.")
                time.sleep(_POLL_S)
            return time.monotonic_ns()

    def predict(self, model: str, samples: Samples) -> tuple[Array, Array, Array, int]:
        """Return torque and its standard deviation, (N, n), the noise's, (n,), and the revision."""
        answer = self.client.predict(model, samples.q, samples.dq, samples.ddq)
        tau, std, noise = (np.array(each) for each in (answer.tau, answer.tau_std, answer.noise_std))
        return tau, std, noise, answer.revision


def install(home: Path, folder: Path, models: Mapping[str, LearningOptions], n_joints: int) -> None:
    """Publish copies of a saved model with these names and learning options in a home that no service uses yet."""
    database, files = Database(home), Files(home)
    try:
        for model, options in models.items():
            name = new_id("mv")
            with files.new_version(name) as target:
                manifest = lipcore.copy_model(folder, target)
            with database.transaction() as session:
                registry.publish(session, model, name, manifest, None)
            set_options(database, model, options, n_joints, time.time())
    finally:
        database.close()


@contextmanager
def serving(home: Path, settings: Mapping[str, Any] | None = None) -> Iterator[Bed]:
    """Serve a home with these additional settings."""
    given = {"home": home, "log_level": "warning", "max_loaded_models": 8, **(settings or {})}
    service = ServiceProcess(0, {f"LIPSERVE_{name.upper()}": str(value) for name, value in given.items()})
    try:
        with Client(service.url) as client:
            service.wait_ready(client)
            yield Bed(("127.0.0.1", service.port), service.process.pid, client)
    finally:
        service.stop()


def train(
    samples: Samples, joint_types: tuple[str, ...], fit: Mapping[str, Any], estimator: str = "lip-chain"
) -> tuple[TorqueModel, float]:
    """Train a model in this process; return it and the time of the training, s."""
    began = time.monotonic()
    model = lipcore.train(samples, joint_types, estimator, lipcore.FitOptions(**fit))
    return model, time.monotonic() - began


def _query(model: str, motion: Array) -> bytes:
    body = dict(zip(("q", "dq", "ddq"), motion.tolist(), strict=True))
    return post(f"/v1/models/{model}/predict", json.dumps(body).encode())
