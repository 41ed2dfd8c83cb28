"""Outages of the PostgreSQL server: clients get Retry-After, and everything recovers by itself."""

import threading
from collections.abc import Iterator
from unittest.mock import patch

import httpx
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from service.app import create_app
from service.storage.database import Database, EventRow
from service.storage.files import Files
from tests.service.data import ADDRESS, ENDLESS, arrays, ended, error, eventually, npz, queue, running, stream, upload
from tests.service.data import job as looked
from tests.service.data import train as train_job
from tests.service.learning.learning_models import LearningModel, observation_batch, publish
from tests.service.server import Server
from tests.system.cluster.pairs import Pair, train

ARM = "arm"


@pytest.fixture
def service(shared) -> Iterator[Pair]:
    """A service with short timeouts."""
    settings = shared.settings(publish_every_s=0.02)
    with (
        patch("service.storage.storage.WAIT_S", 2.0),
        TestClient(create_app(settings), ADDRESS, raise_server_exceptions=False) as client,
    ):
        yield Pair((client,), train(shared.folder / "trained"))


def restart_under_load(postgres, answered):
    """Restart the server twice, each time after two answered requests, and wait for two more."""
    for _ in range(2):
        seen = len(answered)
        eventually(lambda seen=seen: len(answered) >= seen + 2)
        postgres.restart()
    seen = len(answered)
    eventually(lambda: len(answered) >= seen + 2)


def test_requests_get_retry_after_while_server_is_down(service, postgres):
    (pupil,), (client,) = service.enrol(ARM), service.clients
    body = npz(**arrays(stream()))
    upload_request = {"content": body, "headers": {"content-type": "application/x-npz"}}
    requests = [
        ("GET", "/v1/models", {}),
        ("GET", "/v1/jobs", {}),
        ("GET", f"/v1/models/{ARM}", {}),
        ("POST", "/v1/datasets", upload_request),
        ("POST", f"/v1/models/{ARM}/observations", {"json": observation_batch(0)}),
        ("PUT", f"/v1/models/{ARM}/learning", {"json": {}}),
    ]
    postgres.stop()
    try:
        for method, path, request in requests:
            answer = client.request(method, path, **request)
            assert "cannot be reached" in error(answer, 503, "storage_unavailable")["message"], path
            assert answer.headers["retry-after"] == "1"
        not_ready = error(client.get("/health/ready"), 503, "not_ready")
        assert "database" in {item["field"] for item in not_ready["detail"]}
        assert client.get("/health/live").status_code == 200
        assert pupil.predict()["revision"] == 0  # loaded models still serve
    finally:
        postgres.start()
    for method, path, request in requests:
        assert client.request(method, path, **request).is_success, path
    assert pupil.wait_for_revision(1)["revision"] == 1
    eventually(lambda: client.get("/health/ready").status_code == 200)


def test_restarts_under_load_keep_acknowledged_batches(shared, postgres):
    settings = shared.settings("before")
    database = Database.of(settings)
    publish(database, Files.of(settings), train(shared.folder / "trained"), ARM)
    answered: list[int] = []
    revisions: list[int] = []
    failures: list[Exception] = []
    enough = threading.Event()

    def send(client: httpx.Client) -> None:
        number = 0
        try:
            while not enough.is_set():
                answer = client.post(
                    f"/v1/models/{ARM}/observations", json=observation_batch(number % 40, sequence=number)
                )
                if answer.status_code == 200:
                    answered.append(number)
                    revisions.append(answer.json()["revision"])
                    number += 1
                else:
                    assert answer.status_code == 503, answer.text
                    assert answer.headers["retry-after"]
        except Exception as error:
            failures.append(error)

    with Server(shared.home("one"), **shared.env(), LIPSERVE_PUBLISH_EVERY_S="0.1") as server:
        pupil = LearningModel(server.client, ARM)
        pupil.put("learning", {"contact_threshold": 100.0, "on_change": "learn", "auto_refresh": False})
        dataset = upload(server.client, stream())["id"]
        panda = upload(server.client, stream("panda", samples=200))["id"]
        job = queue(server.client, "endless", panda, options=ENDLESS)["id"]
        running(server.client, job)
        with httpx.Client(base_url=server.url, timeout=60) as own:
            sender = threading.Thread(target=send, args=(own,))
            sender.start()
            try:
                restart_under_load(postgres, answered)
            finally:
                enough.set()
                sender.join()
        assert failures == []
        before = looked(server.client, job)["progress"]["iteration"]
        eventually(lambda: looked(server.client, job)["progress"]["iteration"] > before)
        assert server.client.post(f"/v1/jobs/{job}/cancel").is_success
        assert (ended(server.client, job)["state"], looked(server.client, job)["attempts"]) == ("cancelled", 1)
        train_job(server.client, "trained", dataset)
        assert pupil.wait_for_revision(revisions[-1])["revision"] == revisions[-1]
        assert server.client.get("/health/ready").status_code == 200
    with database.session() as session:
        query = select(EventRow.sequence).where(EventRow.kind == "batch").order_by(EventRow.number)
        assert session.scalars(query).all() == answered
    database.close()
