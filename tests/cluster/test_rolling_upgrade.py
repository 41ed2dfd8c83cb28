"""Two services of the release before, upgraded one after the other while clients ask and teach: no answer is missing,
no batch is lost, and both say the same throughout."""

import io
import os
import shutil
import subprocess
import tarfile
import threading
from importlib.util import find_spec
from pathlib import Path

import httpx
import numpy as np
import pytest
from sqlalchemy import create_engine

from service.storage.database.migrations import HEAD, revision
from tests.cluster.pairs import HARMLESS, folder_store
from tests.cluster.servers import Shared
from tests.service.data import DEADLINE, QUICK, eventually, queue, stream, train, upload
from tests.service.faults.ledger import batch
from tests.service.learning.lessons import QUERIES
from tests.service.server import Server

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
EARLIER = ("v0.2.0", "6ef7985")
"""What git may know the release before by."""
FOLDERS = ("service", "lipcore", "clients/python", "models", "docs")
MODEL = "arm"
FREELY = 200
"""Batches that are taught without a pause for what the test does."""
CLOSE = 1e-7
"""Largest difference of torques of two releases, of the largest torque."""


@pytest.fixture(scope="module")
def earlier(tmp_path_factory):
    """The code of the release before."""
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("the release before is in git, which is not here")
    for name in ("torch", "plotly"):
        if find_spec(name) is None:
            pytest.skip(f"the release before needs {name}, which is not installed")
    folder = tmp_path_factory.mktemp("earlier")
    for name in EARLIER:
        made = subprocess.run(["git", "archive", name, *FOLDERS], cwd=ROOT, capture_output=True, check=False)
        if made.returncode == 0:
            with tarfile.open(fileobj=io.BytesIO(made.stdout)) as tar:
                tar.extractall(folder, filter="data")
            keep_compiled(folder)
            return folder
    pytest.skip(f"git knows none of {', '.join(EARLIER)}: a clone without its history")


def keep_compiled(folder):
    """Bring compiled kernels along for sources that are the same: to compile them takes a minute."""
    for source in folder.glob("lipcore/**/*.py"):
        own = ROOT / source.relative_to(folder)
        if not own.exists() or own.read_bytes() != source.read_bytes():
            continue
        os.utime(source, ns=(own.stat().st_atime_ns, own.stat().st_mtime_ns))
        for cache in own.parent.glob(f"__pycache__/{own.stem}.*.nb?"):
            (source.parent / "__pycache__").mkdir(exist_ok=True)
            shutil.copy2(cache, source.parent / "__pycache__")


class Patient(Server):
    """A service whose kernels may have to be compiled first."""

    patience = 5 * DEADLINE


@pytest.fixture
def fleet(postgres, s3, tmp_path, earlier):
    """Starts services by name, of the release before or of this one, on a database that nobody has opened."""
    database = postgres.create_empty()
    shared = Shared(postgres, s3, tmp_path, database, database)
    started: dict[str, Server] = {}
    settings = {
        **{"LIPSERVE_DATABASE_URL": shared.database_url, "LIPSERVE_FILES_URL": folder_store(shared)},
        **{"LIPSERVE_PUBLISH_EVERY_S": "0.05", "LIPSERVE_MIN_REVISION_WAIT_S": "20", "LIPSERVE_REPLICA_LOST_S": "3"},
    }
    old = {"PYTHONPATH": f"{earlier}:{earlier / 'clients/python'}", "PYTHONSAFEPATH": "1"}

    def start(name, before=False):
        started[name] = Patient(shared.home(name), **settings, **(old if before else {}))
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


class Clients:
    """One client that teaches and one that asks, at whichever service answers. urls: of the services that run."""

    def __init__(self, *urls):
        self.urls, self.taught, self.asked, self.failures = list(urls), [], {}, []
        self._over, self._more = threading.Event(), threading.Semaphore(0)
        self._threads = [threading.Thread(target=self._run, args=(act,)) for act in (self._teach, self._ask)]
        for thread in self._threads:
            thread.start()

    def _run(self, act):
        with httpx.Client(timeout=DEADLINE) as http:
            number = 0
            while not self._over.is_set():
                try:
                    act(http, number)
                except BaseException as error:
                    self.failures.append(error)
                    return
                number += 1

    def _any(self, http, number, path, body):
        """What one of the services answers: the next where one is stopping or gone, as behind a balancer."""
        for turn in range(100):
            urls = list(self.urls)
            url = urls[(number + turn) % len(urls)]
            try:
                answer = http.post(url + path, json=body)
            except httpx.TransportError:
                self._over.wait(0.05)
                continue
            if answer.status_code == 503:  # it stops
                self._over.wait(0.05)
                continue
            assert answer.status_code == 200, answer.text
            return url, answer.json()
        raise AssertionError("no service answers")

    def _teach(self, http, _):
        number = len(self.taught)
        if number >= FREELY and not self._more.acquire(timeout=0.1):  # there are no more than 300
            return
        _, said = self._any(http, number, f"/v1/models/{MODEL}/observations", batch(number))
        self.taught.append(said)
        self._over.wait(0.3)

    def _ask(self, http, number):
        url, said = self._any(http, number, f"/v1/models/{MODEL}/predict", QUERIES)
        assert np.isfinite(said["tau"]).all()
        self.asked[url] = self.asked.get(url, 0) + 1
        self._over.wait(0.02)

    def come_round(self, *urls):
        """Wait until each of these services has answered, and batches were taught meanwhile."""
        before, taught = dict(self.asked), len(self.taught)
        self._more.release(2)
        eventually(
            lambda: (
                self.failures
                or (len(self.taught) >= taught + 2 and all(self.asked.get(url, 0) > before.get(url, 0) for url in urls))
            )
        )
        assert self.failures == []

    def end(self):
        self._over.set()
        for thread in self._threads:
            thread.join()


@pytest.fixture
def clients():
    made = []
    yield lambda *urls: made.append(Clients(*urls)) or made[-1]
    for each in made:
        each.end()


def predicted(server, **more):
    answer = server.client.post(f"/v1/models/{MODEL}/predict", json={**QUERIES, **more})
    assert answer.status_code == 200, answer.text
    return answer.json()


def put(server, path, body):
    answer = server.client.put(path, json=body)
    assert answer.status_code == 200, answer.text


def same(one, other, least):
    """See that both services answer alike with all that was taught up to a revision."""
    found = [np.array(predicted(each, min_revision=least, version=1)["tau"]) for each in (one, other)]
    assert np.abs(found[0] - found[1]).max() <= CLOSE * np.abs(found[0]).max()


def test_services_are_upgraded_one_after_the_other(fleet, clients):
    one, two = fleet("one", before=True), fleet("two", before=True)
    assert fleet.revision() == "0004"
    assert one.client.get("/v1/audit").status_code == 404  # they are of the release before
    dataset = upload(one.client, stream())["id"]
    train(one.client, MODEL, dataset)
    put(two, f"/v1/models/{MODEL}/learning", HARMLESS)
    load = clients(one.url, two.url)
    load.come_round(one.url, two.url)

    load.urls.remove(one.url)
    one.terminate()
    load.come_round(two.url)
    one = fleet("one")
    assert fleet.revision() == HEAD
    load.urls.append(one.url)
    load.come_round(one.url, two.url)
    # both releases on one database: what either takes, moves or trains, the other answers with
    put(one, f"/v1/models/{MODEL}/aliases/new", {"version": 1})
    put(two, f"/v1/models/{MODEL}/aliases/old", {"version": 1})
    eventually(lambda: two.client.post(f"/v1/models/{MODEL}/predict", json={**QUERIES, "alias": "new"}).is_success)
    eventually(lambda: one.client.post(f"/v1/models/{MODEL}/predict", json={**QUERIES, "alias": "old"}).is_success)
    lines = one.client.get("/v1/audit", params={"model": MODEL}).json()["items"]
    assert [each["alias"] for each in lines] == ["new"]  # the release before writes none
    for server, model in ((one, "by-new"), (two, "by-old")):
        name = queue(server.client, model, dataset, options=QUICK)["id"]
        for each in (one, two):
            eventually(lambda at=each, job=name: at.client.get(f"/v1/jobs/{job}").json()["state"] == "succeeded")
    load.come_round(one.url, two.url)
    same(one, two, load.taught[-1]["revision"])

    load.urls.remove(two.url)
    two.kill()
    with pytest.raises(AssertionError, match="a later release of LIPServe has used it"):
        fleet("two", before=True)
    two = fleet("two")
    load.urls.append(two.url)
    load.come_round(one.url, two.url)
    load.end()
    assert load.failures == []

    same(one, two, load.taught[-1]["revision"])
    said = [one.client.post(f"/v1/models/{MODEL}/observations", json=batch(n)).json() for n in range(len(load.taught))]
    assert {each["duplicate"] for each in said} == {True}
    assert [each["revision"] for each in load.taught] == list(range(1, len(load.taught) + 1))
    for server in (one, two):
        assert server.client.get(f"/v1/models/{MODEL}/learning").json()["status"]["events"] == len(load.taught)
