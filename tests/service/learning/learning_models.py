"""Learning service with models of a double pendulum, and observation batches for them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from fastapi.testclient import TestClient
from sqlalchemy import select

import lipcore
from service.app import create_app
from service.foundation.settings import Settings
from service.journal import log, snapshots
from service.models import registry
from service.storage.database import AlarmEventRow, Database
from service.storage.files import Files, new_id
from tests.service.data import ADDRESS, ServiceParts, error, eventually, service_of, stream

BATCH_ROWS = 10
"""Rows of a batch; too few to raise the floor of the stated uncertainty."""
RATE = 100.0
"""Rows per second of the streams in the tests."""
QUERIES = {name: getattr(stream(seed=11, samples=20), name).tolist() for name in ("q", "dq", "ddq")}
DEFAULT_OPTIONS = {"contact_threshold": 100.0, "on_change": "learn", "auto_refresh": False}
MODEL_NUMBERS = count()


def publish(database: Database, files: Files, trained: Path, model: str, **how: Any) -> int:
    """Publish the trained model as a version and return its number; `how` is passed to `registry.publish`."""
    folder = new_id("mv")
    with files.new_version(folder) as target:
        manifest = lipcore.copy_model(trained, target)
    with database.transaction() as session:
        return registry.publish(session, model, folder, manifest, None, **how)


@dataclass(frozen=True)
class LearningService:
    """Service with the folder of a trained double-pendulum model."""

    client: TestClient
    trained: Path

    @property
    def service(self) -> ServiceParts:
        return service_of(self.client)

    def create_model(self, model: str | None = None, **options: Any) -> LearningModel:
        """Create a model that learns with these options; by default the contact threshold is out of reach."""
        learning_model = LearningModel(self.client, model or f"own-{next(MODEL_NUMBERS)}")
        self.publish(learning_model.name)
        learning_model.put("learning", DEFAULT_OPTIONS | options)
        return learning_model

    def publish(self, model: str, **how: Any) -> int:
        """Publish the trained model as a version of a model; return its number."""
        return publish(self.service.database, self.service.files, self.trained, model, **how)


@dataclass(frozen=True)
class LearningModel:
    """Model in a learning service; paths are those below the model."""

    client: TestClient
    name: str

    def url(self, path: str) -> str:
        return f"/v1/models/{self.name}/{path}"

    def get(self, path: str, **params: Any) -> dict[str, Any]:
        return read_json(self.client.get(self.url(path), params=params))

    def put(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        return read_json(self.client.put(self.url(path), json=body))

    def post(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        return read_json(self.client.post(self.url(path), json=body))

    def delete(self, path: str) -> dict[str, Any]:
        return read_json(self.client.delete(self.url(path)))

    def expect_error(self, method: str, path: str, status: int, code: str, **request: Any) -> dict[str, Any]:
        """Return the error of a request that is expected to fail."""
        return error(self.client.request(method, self.url(path), **request), status, code)

    def send_batches(self, *numbers: int, stream_id: str = "arm", **changes: Any) -> dict[str, Any]:
        """Send these batches and wait until predictions contain them; return the last acknowledgement."""
        replies = [self.post("observations", observation_batch(number, stream_id, **changes)) for number in numbers]
        self.wait_for_revision(replies[-1]["revision"])
        return replies[-1]

    def wait_for_revision(self, revision: int, queries: dict[str, Any] = QUERIES) -> dict[str, Any]:
        """Return the prediction of queries once it contains a revision."""
        return eventually(lambda: (seen := self.predict(queries))["revision"] >= revision and seen)

    def predict(self, queries: dict[str, Any] = QUERIES) -> dict[str, Any]:
        return self.post("predict", queries)

    def predict_motion(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Return the current prediction of the rows of a batch."""
        return self.predict({name: batch[name] for name in ("q", "dq", "ddq")})

    def find_batch(self, sequence: int, stream_id: str = "arm") -> Any:
        """Return the logged batch with this sequence."""
        with service_of(self.client).database.session() as session:
            return log.find_batch(session, self.name, stream_id, sequence)

    def delete_from_log(self, *sequences: int, stream_id: str = "arm") -> None:
        """Delete batches from the log, as retention does."""
        with service_of(self.client).database.transaction() as session:
            for sequence in sequences:
                event: Any = log.find_batch(session, self.name, stream_id, sequence)
                snapshots._note_forgotten(session, event)
                session.delete(event)

    def list_alarm_events(self) -> list[tuple[str, str]]:
        """Return type and kind of the events that wait for a webhook."""
        with service_of(self.client).database.session() as session:
            bodies = [row.body for row in session.scalars(select(AlarmEventRow).order_by(AlarmEventRow.seq))]
        return [(body["type"], body["kind"]) for body in bodies if body["model"] == self.name]

    def last_audit_entry(self) -> dict[str, Any]:
        """Return the newest entry of the model in the audit log."""
        return read_json(self.client.get("/v1/audit", params={"model": self.name}))["items"][0]


@contextmanager
def start_service(home: Path, trained: Path, **settings: Any) -> Iterator[LearningService]:
    """Start a service that publishes revisions without delay."""
    with TestClient(create_app(Settings(home=home, publish_every_s=0.02, **settings)), ADDRESS) as client:
        yield LearningService(client, trained)


def observation_batch(number: int, stream_id: str = "arm", **changes: Any) -> dict[str, Any]:
    """Return a batch of consecutive rows of one recording."""
    samples = stream(seed=12, samples=400)
    rows = slice(number * BATCH_ROWS, (number + 1) * BATCH_ROWS)
    body = {name: getattr(samples, name)[rows].tolist() for name in ("q", "dq", "ddq", "tau")}
    times = (np.arange(BATCH_ROWS) + number * BATCH_ROWS) / RATE
    return {"stream_id": stream_id, "sequence": number, "t": times.tolist(), **body, **changes}


def read_json(answer: Any) -> dict[str, Any]:
    """Return the body of a response with status 200."""
    assert answer.status_code == 200, answer.text
    return answer.json()


def max_difference(one: dict[str, Any], other: dict[str, Any]) -> float:
    """Return the largest difference of torques and standard deviations between two predictions, N·m."""
    return max(float(np.abs(np.array(one[name]) - np.array(other[name])).max()) for name in ("tau", "tau_std"))
