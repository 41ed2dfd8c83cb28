"""A rolling upgrade of two services under load: no request fails, no batch is lost, and both predict the same."""

import io
import os
import shutil
import subprocess
import tarfile
import threading
from importlib.util import find_spec

import httpx
import numpy as np
import pytest
from sqlalchemy import create_engine

from service.storage.database.migrations import HEAD, revision
from tests import ROOT, unpack
from tests.service.data import DEADLINE, QUICK, eventually, queue, stream, train, upload
from tests.service.learning.learning_models import QUERIES
from tests.service.server import Server
from tests.system.cluster.pairs import LEARN_EVERYTHING
from tests.system.cluster.servers import Shared
from tests.system.faults.ledger import batch

RELEASE_BEFORE = ("v0.2.0", "6ef7985")
"""Names of the previous release in git."""
FOLDERS = ("service", "lipcore", "clients/python", "models", "docs")
MODEL = "arm"
UNPACED_BATCHES = 200
"""Number of batches that are sent without waiting for the test."""
MAX_RELATIVE_DIFFERENCE = 1e-7
"""Largest relative difference of torques between two releases."""


@pytest.fixture(scope="module")
def release_before(tmp_path_factory):
    """The code of the previous release."""
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("the release before is in git, which is not here")
    for name in ("torch", "plotly"):
        if find_spec(name) is None:
            pytest.skip(f"the release before needs {name}, which is not installed")
    folder = tmp_path_factory.mktemp("earlier")
    for name in RELEASE_BEFORE:
        made = subprocess.run(["git", "archive", name, *FOLDERS], cwd=ROOT, capture_output=True, check=False)
        if made.returncode == 0:
            with tarfile.open(fileobj=io.BytesIO(made.stdout)) as tar:
                unpack(tar, folder)
            keep_compiled(folder)
            return folder
    pytest.skip(f"git knows none of {', '.join(RELEASE_BEFORE)}: a clone without its history")


def keep_compiled(folder):
    """Copy compiled kernels of unchanged sources, because compiling takes a minute."""
    for source in folder.glob("lipcore/**/*.py"):
        own = ROOT / source.relative_to(folder)
        if not own.exists() or own.read_bytes() != source.read_bytes():
            continue
        os.utime(source, ns=(own.stat().st_atime_ns, own.stat().st_mtime_ns))
        for cache in own.parent.glob(f"__pycache__/{own.stem}.*.nb?"):
            (source.parent / "__pycache__").mkdir(exist_ok=True)
            shutil.copy2(cache, source.parent / "__pycache__")


class PatientServer(Server):
    """A service that may have to compile its kernels first."""

    patience = 5 * DEADLINE


@pytest.fixture
def fleet(postgres, s3, tmp_path, release_before):
    """Return a function that starts services by name, of the previous release or this one, on a new database."""
    database = postgres.create_empty()
    shared = Shared(postgres, s3, tmp_path, database, database)
    started: dict[str, Server] = {}
    settings = {
        **{"LIPSERVE_DATABASE_URL": shared.database_url, "LIPSERVE_FILES_URL": shared.folder_url},
        **{"LIPSERVE_PUBLISH_EVERY_S": "0.05", "LIPSERVE_MIN_REVISION_WAIT_S": "20", "LIPSERVE_REPLICA_LOST_S": "3"},
    }
    old = {"PYTHONPATH": f"{release_before}:{release_before / 'clients/python'}", "PYTHONSAFEPATH": "1"}

    def start(name, before=False):
        started[name] = PatientServer(shared.home(name), **settings, **(old if before else {}))
        return started[name]

    start.revision = lambda: revision_of(shared.database_url)
    yield start
    for server in started.values():
        server.__exit__(None, None, None)
    postgres.drop(database)


def revision_of(url):
    engine = create_engine(url.replace("postgresql://", "postgresql+psycopg://", 1))
    with engine.connect() as connection:
        known = revision(connection)
    engine.dispose()
    return known


class LoadClients:
    """One client that sends batches and one that predicts, at any of the services in `urls`."""

    def __init__(self, *urls):
        self.urls, self.sent, self.predictions_by_url, self.failures = list(urls), [], {}, []
        self._stopped, self._permits = threading.Event(), threading.Semaphore(0)
        self._threads = [
            threading.Thread(target=self._run, args=(operation,)) for operation in (self._send_batch, self._predict)
        ]
        for thread in self._threads:
            thread.start()

    def _run(self, operation):
        with httpx.Client(timeout=DEADLINE) as http:
            number = 0
            while not self._stopped.is_set():
                try:
                    operation(http, number)
                except BaseException as error:
                    self.failures.append(error)
                    return
                number += 1

    def _post_to_any(self, http, number, path, body):
        """Return the first response of a service; skip those that are stopping or gone, as a load balancer does."""
        for turn in range(100):
            urls = list(self.urls)
            url = urls[(number + turn) % len(urls)]
            try:
                answer = http.post(url + path, json=body)
            except httpx.TransportError:
                self._stopped.wait(0.05)
                continue
            if answer.status_code == 503:  # it is stopping
                self._stopped.wait(0.05)
                continue
            assert answer.status_code == 200, answer.text
            return url, answer.json()
        raise AssertionError("no service answers")

    def _send_batch(self, http, _):
        number = len(self.sent)
        if number >= UNPACED_BATCHES and not self._permits.acquire(timeout=0.1):  # there are fewer than 300
            return
        _, response = self._post_to_any(http, number, f"/v1/models/{MODEL}/observations", batch(number))
        self.sent.append(response)
        self._stopped.wait(0.3)

    def _predict(self, http, number):
        url, response = self._post_to_any(http, number, f"/v1/models/{MODEL}/predict", QUERIES)
        assert np.isfinite(response["tau"]).all()
        self.predictions_by_url[url] = self.predictions_by_url.get(url, 0) + 1
        self._stopped.wait(0.02)

    def wait_for_answers_of(self, *urls):
        """Wait until each of these services has answered, and new batches were sent."""
        before, sent = dict(self.predictions_by_url), len(self.sent)
        self._permits.release(2)
        eventually(
            lambda: (
                self.failures
                or (
                    len(self.sent) >= sent + 2
                    and all(self.predictions_by_url.get(url, 0) > before.get(url, 0) for url in urls)
                )
            )
        )
        assert self.failures == []

    def stop(self):
        self._stopped.set()
        for thread in self._threads:
            thread.join()


@pytest.fixture
def clients():
    made = []
    yield lambda *urls: made.append(LoadClients(*urls)) or made[-1]
    for each in made:
        each.stop()


def predict_queries(server, **more):
    answer = server.client.post(f"/v1/models/{MODEL}/predict", json={**QUERIES, **more})
    assert answer.status_code == 200, answer.text
    return answer.json()


def put(server, path, body):
    answer = server.client.put(path, json=body)
    assert answer.status_code == 200, answer.text


def check_same_torques(one, other, min_revision):
    """Check that both services predict the same with everything up to a revision."""
    found = [np.array(predict_queries(each, min_revision=min_revision, version=1)["tau"]) for each in (one, other)]
    assert np.abs(found[0] - found[1]).max() <= MAX_RELATIVE_DIFFERENCE * np.abs(found[0]).max()


def test_rolling_upgrade_loses_no_response_and_no_batch(fleet, clients):
    one, two = fleet("one", before=True), fleet("two", before=True)
    assert fleet.revision() == "0004"
    assert one.client.get("/v1/audit").status_code == 404  # both run the previous release
    dataset = upload(one.client, stream())["id"]
    train(one.client, MODEL, dataset)
    put(two, f"/v1/models/{MODEL}/learning", LEARN_EVERYTHING)
    load = clients(one.url, two.url)
    load.wait_for_answers_of(one.url, two.url)

    load.urls.remove(one.url)
    one.terminate()
    load.wait_for_answers_of(two.url)
    one = fleet("one")
    assert fleet.revision() == HEAD
    load.urls.append(one.url)
    load.wait_for_answers_of(one.url, two.url)
    # both releases on one database: each serves what the other receives, moves or trains
    put(one, f"/v1/models/{MODEL}/aliases/new", {"version": 1})
    put(two, f"/v1/models/{MODEL}/aliases/old", {"version": 1})
    eventually(lambda: two.client.post(f"/v1/models/{MODEL}/predict", json={**QUERIES, "alias": "new"}).is_success)
    eventually(lambda: one.client.post(f"/v1/models/{MODEL}/predict", json={**QUERIES, "alias": "old"}).is_success)
    lines = one.client.get("/v1/audit", params={"model": MODEL}).json()["items"]
    assert [each["alias"] for each in lines] == ["new"]  # the previous release writes no audit log
    for server, model in ((one, "by-new"), (two, "by-old")):
        name = queue(server.client, model, dataset, options=QUICK)["id"]
        for each in (one, two):
            eventually(lambda at=each, job=name: at.client.get(f"/v1/jobs/{job}").json()["state"] == "succeeded")
    load.wait_for_answers_of(one.url, two.url)
    check_same_torques(one, two, load.sent[-1]["revision"])

    load.urls.remove(two.url)
    two.kill()
    with pytest.raises(AssertionError, match="a later release of LIPServe has used it"):
        fleet("two", before=True)
    two = fleet("two")
    load.urls.append(two.url)
    load.wait_for_answers_of(one.url, two.url)
    load.stop()
    assert load.failures == []

    check_same_torques(one, two, load.sent[-1]["revision"])
    response = [
        one.client.post(f"/v1/models/{MODEL}/observations", json=batch(n)).json() for n in range(len(load.sent))
    ]
    assert {each["duplicate"] for each in response} == {True}
    assert [each["revision"] for each in load.sent] == list(range(1, len(load.sent) + 1))
    for server in (one, two):
        assert server.client.get(f"/v1/models/{MODEL}/learning").json()["status"]["events"] == len(load.sent)
