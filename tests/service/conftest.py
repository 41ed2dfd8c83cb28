"""Services that tests share, as starting one loads torch and a model, and training in one starts a process."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import pytest
from fastapi.testclient import TestClient

import lipcore
from lipcore import Samples, TorqueModel
from service.api.limits import requests
from service.app import create_app
from service.contract.jobs import MAX_OPTIONS
from service.foundation.settings import Settings
from service.models import registry
from tests.service import backend
from tests.service.data import ADDRESS, service_of, stream, train, upload
from tests.service.server import Server
from tests.service.streams import Streaming, saved_model
from tests.service.warm import warm_processes

# tests run in parallel: processes with a low priority would hardly run
for name, value in (("TRAINING_NICENESS", "0"), ("LEARNER_NICENESS", "0"), ("TRAINING_CPUS", "1000")):
    os.environ.setdefault(f"LIPSERVE_{name}", value)

LIMITS = {
    "max_upload_bytes": 200_000,
    "max_unpacked_bytes": 400_000,
    "max_request_bytes": 20_000,
    "max_joints": 8,
    "max_samples": 500,
}
"""Limits small enough to exceed in a test."""
BODY_LIMITS = {"MAX_URDF_BYTES": 5_000, "MAX_ARCHIVE_BYTES": 100_000}
"""The same for constants that are read when an application is created."""
CONSTANTS = {
    "service.inference.predicting.MAX_BATCH": 20,
    "service.inference.evaluating.MAX_EVALUATION_SAMPLES": 50,
    "service.api.dependencies.MAX_PAGE": 3,
    "service.training.requests.MAX_DATASETS": 2,
    "service.training.jobs.MAX_QUEUED": 2,
    "service.training.requests.MAX_OPTIONS": {**MAX_OPTIONS, "hyperparameter_samples": 30, "posterior_samples": 40},
}
"""The same for constants that are read at each request."""


@pytest.fixture(scope="session", autouse=True)
def services_share(request: pytest.FixtureRequest) -> Iterator[bool]:
    """Whether services share a database and files, see `tests.service.backend`."""
    if request.config.getoption("backend") == backend.OWN:
        yield False
        return
    with backend.shared():
        yield True


@pytest.fixture(scope="session", autouse=True)
def _warm_processes() -> Iterator[None]:
    with warm_processes():
        yield


@pytest.fixture(autouse=True)
def _own_files(request: pytest.FixtureRequest, services_share: bool) -> None:
    """Skip tests marked `@pytest.mark.own_files("why")` if services share their files."""
    marker = request.node.get_closest_marker("own_files")
    if services_share and marker is not None:
        pytest.skip(f"of a service alone: {marker.args[0]}")


@pytest.fixture(scope="session")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A service with default settings; its data sets and models accumulate over the session."""
    with TestClient(create_app(Settings(home=tmp_path_factory.mktemp("api"), promotion="always")), ADDRESS) as client:
        yield client


@pytest.fixture(scope="session")
def strict_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A service with small limits."""
    with patch.multiple(requests, **BODY_LIMITS):
        app = create_app(Settings(home=tmp_path_factory.mktemp("strict"), **LIMITS))
    with TestClient(app, ADDRESS) as client:
        yield client


@pytest.fixture
def strict(strict_service: TestClient, monkeypatch: pytest.MonkeyPatch) -> Iterator[TestClient]:
    """The service with small limits, without data sets at the start of every test."""
    for place, value in CONSTANTS.items():
        monkeypatch.setattr(place, value)
    yield strict_service
    while left := strict_service.get("/v1/datasets").json()["items"]:
        for dataset in left:
            assert strict_service.delete(f"/v1/datasets/{dataset['id']}").status_code == 204


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A service in a process of its own."""
    limits = {f"LIPSERVE_{name.upper()}": str(LIMITS[name]) for name in ("max_upload_bytes", "max_request_bytes")}
    with Server(tmp_path_factory.mktemp("server"), warm=True, **limits) as started:
        yield started


@pytest.fixture(scope="session")
def streaming(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Streaming]:
    """A service in a process of its own that has a model for torque streams of a double pendulum."""
    with Server(tmp_path_factory.mktemp("streaming"), warm=True) as started:
        dataset = upload(started.client, stream())["id"]
        train(started.client, "pendulum", dataset)
        yield Streaming(started, dataset, saved_model(started, "pendulum", 1))


@pytest.fixture(scope="session")
def pendulum(api: TestClient) -> dict[str, object]:
    """A data set of a double pendulum."""
    return upload(api, stream(), name="pendulum")


@dataclass(frozen=True)
class Trained:
    """A model of a double pendulum: its name and data set in the service, and lipcore's copy of it."""

    name: str
    dataset: str
    samples: Samples
    model: TorqueModel


@pytest.fixture(scope="session")
def trained(api: TestClient, pendulum: dict[str, str]) -> Trained:
    """A model of version 1 that no test adds versions to."""
    train(api, "pendulum", pendulum["id"])
    service = service_of(api)
    folder = registry.find(service.database, "pendulum", 1).folder
    return Trained("pendulum", pendulum["id"], stream(), lipcore.load(service.files.version_folder(folder)))


@pytest.fixture
def no_worker(strict: TestClient, monkeypatch: pytest.MonkeyPatch) -> TestClient:
    """The service with small limits, in which queued jobs stay queued."""
    monkeypatch.setattr(service_of(strict).jobs, "submit", lambda job: None)
    return strict


@pytest.fixture
def fresh_readiness(api: TestClient) -> Iterator[None]:
    """Clear the cached readiness before and after the test."""
    service_of(api).readiness.forget()
    yield
    service_of(api).readiness.forget()


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """An empty home."""
    return tmp_path / "home"
