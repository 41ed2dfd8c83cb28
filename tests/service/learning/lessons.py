"""A service in which models of a double pendulum learn, and batches to teach them with."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from fastapi.testclient import TestClient

import lipcore
from service.app import create_app
from service.foundation.settings import Settings
from service.models import registry
from service.storage.database import Database
from service.storage.files import Files, new_id
from tests.service.data import ADDRESS, Parts, error, eventually, service_of, stream

LESSON = 10
"""Rows of a batch: so few that the stated uncertainty is not yet held against the errors seen."""
RATE = 100.0
"""Rows a second of the streams that tests send."""
QUERIES = {name: getattr(stream(seed=11, samples=20), name).tolist() for name in ("q", "dq", "ddq")}


def publish(database: Database, files: Files, trained: Path, model: str, **how: Any) -> int:
    """Add a version to a model, as trained; how: as in `registry.publish`. Return its number."""
    folder = new_id("mv")
    with files.new_version(folder) as target:
        manifest = lipcore.copy_model(trained, target)
    with database.transaction() as session:
        return registry.publish(session, model, folder, manifest, None, **how)


@dataclass(frozen=True)
class School:
    """A service, and the folder of a trained model of a double pendulum."""

    client: TestClient
    trained: Path

    @property
    def service(self) -> Parts:
        """The parts of the service."""
        return service_of(self.client)

    def enrol(self, model: str, **options: Any) -> Pupil:
        """A new model, as trained, that learns with these options; contacts are far off unless said."""
        self.publish(model)
        pupil = Pupil(self.client, model)
        pupil.put("learning", {"contact_threshold": 100.0, "on_change": "learn", "auto_refresh": False, **options})
        return pupil

    def publish(self, model: str, **how: Any) -> int:
        """Add a version to a model; return its number."""
        return publish(self.service.database, self.service.files, self.trained, model, **how)


@dataclass(frozen=True)
class Pupil:
    """A model that learns."""

    client: TestClient
    model: str

    def url(self, path: str) -> str:
        """Where something of the model is found."""
        return f"/v1/models/{self.model}/{path}"

    def get(self, path: str, **params: Any) -> dict[str, Any]:
        """What is found there."""
        return answered(self.client.get(self.url(path), params=params))

    def put(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        """The answer to a PUT."""
        return answered(self.client.put(self.url(path), json=body))

    def post(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        """The answer to a POST."""
        return answered(self.client.post(self.url(path), json=body))

    def delete(self, path: str) -> dict[str, Any]:
        """The answer to a DELETE."""
        return answered(self.client.delete(self.url(path)))

    def refused(self, method: str, path: str, status: int, code: str, **request: Any) -> dict[str, Any]:
        """The error that a request is answered with."""
        return error(self.client.request(method, self.url(path), **request), status, code)

    def teach(self, *numbers: int, stream_id: str = "arm", **changes: Any) -> dict[str, Any]:
        """Send lessons of these numbers; wait until answers contain them. Return what was said of the last."""
        said = [self.post("observations", lesson(number, stream_id, **changes)) for number in numbers]
        self.settled(said[-1]["revision"])
        return said[-1]

    def settled(self, revision: int) -> dict[str, Any]:
        """The answer to QUERIES once it contains a revision."""
        return eventually(lambda: (seen := self.predict())["revision"] >= revision and seen)

    def predict(self, queries: dict[str, Any] = QUERIES) -> dict[str, Any]:
        """The answer to queries as it is now."""
        return self.post("predict", queries)


@contextmanager
def school(home: Path, trained: Path, **settings: Any) -> Iterator[School]:
    """A service that publishes what it has learnt at once."""
    with TestClient(create_app(Settings(home=home, publish_every_s=0.02, **settings)), ADDRESS) as client:
        yield School(client, trained)


def lesson(number: int, stream_id: str = "arm", **changes: Any) -> dict[str, Any]:
    """The batch of a number: rows of one recording, one lesson after the other."""
    taught = stream(seed=12, samples=400)
    rows = slice(number * LESSON, (number + 1) * LESSON)
    body = {name: getattr(taught, name)[rows].tolist() for name in ("q", "dq", "ddq", "tau")}
    times = (np.arange(LESSON) + number * LESSON) / RATE
    return {"stream_id": stream_id, "sequence": number, "t": times.tolist(), **body, **changes}


def answered(answer: Any) -> dict[str, Any]:
    """The body of an answer of status 200."""
    assert answer.status_code == 200, answer.text
    return answer.json()


def apart(one: dict[str, Any], other: dict[str, Any]) -> float:
    """Largest difference of torques and their standard deviations between two answers, N·m."""
    return max(float(np.abs(np.array(one[name]) - np.array(other[name])).max()) for name in ("tau", "tau_std"))
