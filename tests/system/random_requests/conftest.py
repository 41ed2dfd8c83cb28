"""A service that receives generated requests, and a summary of its responses."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import inf
from typing import Any

import pytest
import schemathesis
import schemathesis.specs.openapi.schemas  # before services run: compiling beside them trips over Python 3.11
from fastapi.testclient import TestClient

from service.app import create_app
from service.foundation.settings import Settings
from service.training import metrics
from tests.service.conftest import (  # noqa: F401 - fixtures
    _own_files,
    _warm_processes,
    home,
    services_share,
)
from tests.service.data import ADDRESS, service_of, stream, upload
from tests.service.robots.test_robots import urdf
from tests.system.random_requests.document import fitting, narrowed

TALLY: Counter[tuple[str, int]] = Counter()
"""Generated requests by operation and status of the answer, of the whole session."""


@dataclass
class FuzzedService:
    """A service and the OpenAPI document: complete, with existing resources in paths, and with fitting bodies too."""

    client: TestClient
    document: Any
    narrowed: Any
    fitting: Any
    tally: Counter[tuple[str, int]] = field(default_factory=lambda: TALLY)


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FuzzedService]:
    """A service whose jobs stay queued, because only the responses matter."""
    settings = Settings(home=tmp_path_factory.mktemp("fuzzed"))
    with (
        pytest.MonkeyPatch.context() as patch,
        TestClient(create_app(settings), ADDRESS, raise_server_exceptions=False) as client,
    ):
        patch.setattr(service_of(client).jobs, "submit", lambda job: None)
        patch.setattr("service.training.jobs.MAX_QUEUED", 10_000)
        patch.setattr(metrics, "START_S", inf)  # it stays ready although no job starts
        known = {
            "model": ["panda-sim"],
            "version": [1],
            "dataset": [upload(client, stream())["id"]],
            "robot": [_robot(client)],
            "stream_id": ["cell-3"],
            "sequence": [0],
            "alias": ["serving", "best"],
            "min_revision": [0],  # the service would wait for any other value
        }
        known["job"] = [_job(client, known["dataset"][0])]
        document = client.get("/openapi.json").json()
        batch = document["components"]["schemas"]["ObservationRequest"]["examples"][0]
        assert client.post("/v1/models/panda-sim/observations", json=batch).status_code == 200
        read = schemathesis.openapi.from_dict
        yield FuzzedService(
            client, read(document), read(narrowed(document, known)), read(fitting(document, known, joints=7))
        )


def _robot(client: TestClient) -> str:
    answer = client.post("/v1/robots", content=urdf(), headers={"content-type": "application/xml"})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def _job(client: TestClient, dataset: str) -> str:
    answer = client.post("/v1/jobs", json={"model": "fuzzed", "datasets": [dataset]})
    assert answer.status_code == 202, answer.text
    return str(answer.json()["id"])


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the number of generated requests and their response codes."""
    if TALLY:
        statuses: Counter[int] = Counter()
        for (_, status), count in TALLY.items():
            statuses[status] += count
        answered = ", ".join(f"{count} x {status}" for status, count in sorted(statuses.items()))
        operations = len({operation for operation, _ in TALLY})
        terminalreporter.write_line(f"generated requests: {TALLY.total()} to {operations} operations: {answered}")
