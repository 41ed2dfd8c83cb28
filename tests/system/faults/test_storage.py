"""Full disks and a locked database: writes fail with an error, and the service recovers."""

import time
from collections.abc import Iterator

import httpx
import pytest

from lipserve import StreamClient
from service.storage.database.engine import PATIENCE_S
from tests.service.data import arrays, error, eventually, npz, stream
from tests.service.robots.test_robots import urdf
from tests.system.faults.actions import Observe, Serve, Train, Unlearn, Upload, UploadRobot
from tests.system.faults.harness import FaultHarness
from tests.system.faults.ledger import ARM, batch, list_items, predict_queries
from tests.system.faults.storage import fill_disk, lock_database, small_disk

MiB = 1 << 20
WRITES = ("dataset", "robot", "job", "observation", "unlearning", "serving", "learning")


@pytest.fixture(scope="module")
def harness(tmp_path_factory) -> Iterator[FaultHarness]:
    """A harness on its own disk if one can be mounted; requests wait only briefly for the database."""
    folder = tmp_path_factory.mktemp("storage") / "disk"
    with (
        small_disk(folder, 48 * MiB) as mounted,
        FaultHarness(folder, set(), DATABASE_TIMEOUT_S="0.2", MIN_FREE_BYTES="0") as made,
    ):
        made.has_own_disk = mounted
        for each in (Upload, UploadRobot, Train, Observe, Observe):
            each().request(made)
        made.verify()
        yield made


def send_write(harness: FaultHarness, what: str) -> httpx.Response:
    """Send a request that writes; return the response."""
    client = harness.client
    if what == "dataset":
        body = npz(**arrays(stream(samples=2000, seed=3)))
        return client.post("/v1/datasets", content=body, headers={"content-type": "application/x-npz"})
    if what == "robot":
        return client.post("/v1/robots", content=urdf("late"), headers={"content-type": "application/xml"})
    if what == "job":
        return client.post("/v1/jobs", json={"model": "late", "datasets": [next(iter(harness.ledger.datasets))]})
    if what == "observation":
        return client.post(f"/v1/models/{ARM}/observations", json=batch(max(harness.ledger.batches) + 1))
    if what == "unlearning":
        return client.delete(f"/v1/models/{ARM}/observations/robot-1/0")
    if what == "serving":
        return client.post(f"/v1/models/{ARM}/rollback", json={"version": 3 - harness.ledger.serving})
    return client.put(f"/v1/models/{ARM}/learning", json={"contact_threshold": 5.0})


def check_reads_work(harness: FaultHarness) -> None:
    """Check that requests that write nothing succeed."""
    assert predict_queries(harness.client, ARM)["version"] == harness.ledger.serving
    for path in ("/v1/datasets", "/v1/jobs", "/v1/models"):
        assert list_items(harness.client, path)
    assert harness.client.get("/health/live").status_code == 200


def check_recovered(harness: FaultHarness) -> None:
    """Check that rejected requests had no effect, and that writes succeed again."""
    eventually(lambda: harness.client.get("/health/ready").status_code == 200)
    harness.verify()
    for each in (Upload, Observe, Unlearn, Serve, Train):
        each().request(harness)
    harness.verify()


def test_writes_get_retry_after_while_database_is_locked(harness):
    with lock_database(harness.home / "lipserve.sqlite3"):
        for what in WRITES:
            answer = send_write(harness, what)
            error(answer, 503, "storage_unavailable")
            assert int(answer.headers["retry-after"]) >= 1
        check_reads_work(harness)
    check_recovered(harness)


def test_job_survives_long_database_lock(harness):
    """The lock lasts longer than the training process waits for it."""
    Train().request(harness)
    name = list(harness.ledger.jobs)[-1]
    with lock_database(harness.home / "lipserve.sqlite3"):
        end = time.monotonic() + PATIENCE_S + 5.0
        eventually(lambda: time.monotonic() > end, 2 * PATIENCE_S)
        assert harness.client.get(f"/v1/jobs/{name}").json()["state"] in ("queued", "running", "succeeded")
        check_reads_work(harness)
    check_recovered(harness)


def test_stream_resends_rows_that_were_not_logged(harness):
    rows, model = stream(samples=60, seed=9), next(iter(harness.ledger.models))
    unlogged = [{name: getattr(rows, name)[i] for name in ("q", "dq", "ddq", "tau")} for i in range(20)]
    with StreamClient(model, harness.server.url, stream_id="frames") as client:
        with lock_database(harness.home / "lipserve.sqlite3"):
            for each in unlogged:
                client.predict(**each)
            eventually(lambda: client.predict(**unlogged[0] | {"tau": None}) and client.refusals)
        # with two planes, frames do not wait for the control plane as long as that waits for a locked database
        assert client.refusals[0].code in ("storage_unavailable", "not_ready")
        assert client.learnt.through == 0
    with StreamClient(model, harness.server.url, stream_id="frames") as client:
        for each in unlogged:
            client.predict(**each)
        eventually(lambda: client.predict(**unlogged[0] | {"tau": None}) and client.learnt.through == len(unlogged))
    harness.verify()


def test_full_disk_returns_storage_full(harness):
    if not harness.has_own_disk:
        pytest.skip("this process may not mount a disk")
    with fill_disk(harness.home.parent):
        for what in WRITES:
            error(send_write(harness, what), 507, "storage_full")
        check_reads_work(harness)
    check_recovered(harness)
