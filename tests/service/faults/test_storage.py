"""Disks that are full, a database that another process writes to: nothing breaks for good."""

import time
from collections.abc import Iterator

import httpx
import pytest

from lipserve import StreamClient
from service.storage.database.engine import PATIENCE_S
from tests.service.data import arrays, error, eventually, npz, stream
from tests.service.faults.actions import Observe, Serve, Train, Unlearn, Upload, UploadRobot
from tests.service.faults.house import House
from tests.service.faults.ledger import ARM, batch, listed, predicted
from tests.service.faults.storage import full, locked, small_disk
from tests.service.test_robots import urdf

pytestmark = pytest.mark.slow
MiB = 1 << 20
WRITES = ("dataset", "robot", "job", "observation", "unlearning", "serving", "learning")


@pytest.fixture(scope="module")
def house(tmp_path_factory) -> Iterator[House]:
    """A house on a disk of its own, as far as one can be had; requests wait for the database for a moment only."""
    folder = tmp_path_factory.mktemp("storage") / "disk"
    with (
        small_disk(folder, 48 * MiB) as mounted,
        House(folder, set(), DATABASE_TIMEOUT_S="0.2", MIN_FREE_BYTES="0") as made,
    ):
        made.has_own_disk = mounted
        for each in (Upload, UploadRobot, Train, Observe, Observe):
            each().ask(made)
        made.verify()
        yield made


def asked(house: House, what: str) -> httpx.Response:
    """The answer to a request that writes."""
    client = house.client
    if what == "dataset":
        body = npz(**arrays(stream(samples=2000, seed=3)))
        return client.post("/v1/datasets", content=body, headers={"content-type": "application/x-npz"})
    if what == "robot":
        return client.post("/v1/robots", content=urdf("late"), headers={"content-type": "application/xml"})
    if what == "job":
        return client.post("/v1/jobs", json={"model": "late", "datasets": [next(iter(house.ledger.datasets))]})
    if what == "observation":
        return client.post(f"/v1/models/{ARM}/observations", json=batch(max(house.ledger.batches) + 1))
    if what == "unlearning":
        return client.delete(f"/v1/models/{ARM}/observations/robot-1/0")
    if what == "serving":
        return client.post(f"/v1/models/{ARM}/rollback", json={"version": 3 - house.ledger.serving})
    return client.put(f"/v1/models/{ARM}/learning", json={"contact_threshold": 5.0})


def still_answers(house: House) -> None:
    """What writes nothing goes on."""
    assert predicted(house.client, ARM)["version"] == house.ledger.serving
    for path in ("/v1/datasets", "/v1/jobs", "/v1/models"):
        assert listed(house.client, path)
    assert house.client.get("/health/live").status_code == 200


def recovered(house: House) -> None:
    """Nothing of what was refused is there, and everything is possible again."""
    eventually(lambda: house.client.get("/health/ready").status_code == 200)
    house.verify()
    for each in (Upload, Observe, Unlearn, Serve, Train):
        each().ask(house)
    house.verify()


def test_while_another_process_writes_requests_are_told_to_come_again(house):
    with locked(house.home / "lipserve.sqlite3"):
        for what in WRITES:
            answer = asked(house, what)
            error(answer, 503, "storage_unavailable")
            assert int(answer.headers["retry-after"]) >= 1
        still_answers(house)
    recovered(house)


def test_a_job_outlasts_a_database_that_is_locked_for_long(house):
    """Longer than the training process waits for it by itself."""
    Train().ask(house)
    name = list(house.ledger.jobs)[-1]
    with locked(house.home / "lipserve.sqlite3"):
        end = time.monotonic() + PATIENCE_S + 5.0
        eventually(lambda: time.monotonic() > end, 2 * PATIENCE_S)
        assert house.client.get(f"/v1/jobs/{name}").json()["state"] in ("queued", "running", "succeeded")
        still_answers(house)
    recovered(house)


def test_a_stream_is_told_what_was_not_logged_and_can_send_it_again(house):
    rows, model = stream(samples=60, seed=9), next(iter(house.ledger.models))
    sent = [{name: getattr(rows, name)[i] for name in ("q", "dq", "ddq", "tau")} for i in range(20)]
    with StreamClient(model, house.server.url, stream_id="frames") as client:
        with locked(house.home / "lipserve.sqlite3"):
            for each in sent:
                client.predict(**each)
            eventually(lambda: client.predict(**sent[0] | {"tau": None}) and client.refusals)
        assert client.refusals[0].code == "storage_unavailable"
        assert client.learnt.through == 0
    with StreamClient(model, house.server.url, stream_id="frames") as client:
        for each in sent:
            client.predict(**each)
        eventually(lambda: client.predict(**sent[0] | {"tau": None}) and client.learnt.through == len(sent))
    house.verify()


def test_a_full_disk_is_said_to_be_full(house):
    if not house.has_own_disk:
        pytest.skip("this process may not mount a disk")
    with full(house.home.parent):
        for what in WRITES:
            error(asked(house, what), 507, "storage_full")
        still_answers(house)
    recovered(house)
