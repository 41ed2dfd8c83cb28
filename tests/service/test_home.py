"""Startup on an existing home: interrupted work is cleaned up, finished work is kept, and the home is locked."""

import fcntl
import json
import os
import shutil
import stat
import subprocess
import sys

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from service.app import create_app
from service.foundation.settings import Settings
from service.models import shipped
from service.runtime.process import THREAD_VARIABLES
from service.storage.database import Database, JobRow, VersionRow, now
from service.storage.files import Files
from service.storage.storage import HomeInUseError, lock_home
from tests.service.data import ADDRESS, DEADLINE, QUICK, ended, error, job, stream, train, upload
from tests.service.warm import Served

QUERY = {"q": [0.3, -0.2], "dq": [0.1, 0.4], "ddq": [1.0, -0.5], "covariance": True}


def start_service(home):
    return TestClient(create_app(Settings(home=home)), ADDRESS)


def interrupted_job(name, dataset, model="again", state="running", **fields):
    """Return the row of a job that an earlier run had not finished."""
    request = {"datasets": [dataset], "estimator": "lip", "joint_types": ["revolute"] * 2, "options": QUICK}
    progress = {"stage": "hyperparameters", "iteration": 3}
    return JobRow(id=name, model=model, state=state, request=request, progress=progress, created_at=now(), **fields)


@pytest.fixture(scope="module")
def second_start(tmp_path_factory):
    """A service started on the home of an interrupted one, the earlier answers, and that home."""
    home = tmp_path_factory.mktemp("home")
    with start_service(home) as api:
        dataset = upload(api, stream())["id"]
        train(api, "kept", dataset)
        before = {
            "predict": api.post("/v1/models/kept/predict", json=QUERY).json(),
            "datasets": api.get("/v1/datasets").json(),
            "models": api.get("/v1/models").json(),
        }
    database = Database.of(Settings(home=home))
    with database.transaction() as session:
        for name, attempts, unwanted in (("again", 1, False), ("enough", 3, False), ("unwanted", 1, True)):
            session.add(interrupted_job(f"job_{name}", dataset, attempts=attempts, cancel_requested=unwanted))
        for number in (1, 2):
            session.add(interrupted_job(f"job_waiting{number}", dataset, attempts=0, model="waiting", state="queued"))
    database.close()
    (home / "uploads/tmpabc").write_bytes(b"half an upload")
    (home / "datasets/ds_0123.draft").write_bytes(b"half a data set")
    (home / "datasets/ds_0123.safetensors").write_bytes(b"a data set without a row")
    (home / "versions/.draft-x").mkdir()
    (home / "versions/.draft-x/model.safetensors").write_bytes(b"half a model")
    shutil.copytree(next(home.glob("versions/mv_*")), home / "versions/mv_without_a_row")
    with start_service(home) as api:
        yield api, before, home


@pytest.mark.slow
def test_finished_work_is_kept(second_start):
    api, before, _ = second_start
    assert api.get("/v1/datasets").json() == before["datasets"]
    models = {item["name"]: item for item in api.get("/v1/models").json()["items"]}
    assert [models[item["name"]] for item in before["models"]["items"]] == before["models"]["items"]
    assert models["panda-sim"]["latest_version"] == 1  # the shipped model is registered once
    assert api.post("/v1/models/kept/predict", json=QUERY).json() == before["predict"]


@pytest.mark.slow
def test_leftovers_of_interrupted_writes_are_swept(second_start):
    api, before, home = second_start
    assert list((home / "uploads").iterdir()) == []
    datasets = {f"{item['id']}.safetensors" for item in before["datasets"]["items"]}
    assert {path.name for path in (home / "datasets").iterdir()} == datasets
    ended(api, "job_waiting2")
    names = {path.name for path in (home / "versions").iterdir()}
    assert len(names) == 5  # panda-sim, kept, and the three trained after the restart
    assert not names & {".draft-x", "mv_without_a_row"}


@pytest.mark.slow
def test_interrupted_jobs_are_done_again_up_to_three_times_or_cancelled(second_start):
    api, _, _ = second_start
    seen = ended(api, "job_again")
    assert (seen["state"], seen["attempts"], seen["version"]) == ("succeeded", 2, 1)
    seen = job(api, "job_enough")
    assert (seen["state"], seen["attempts"], seen["error"]["code"]) == ("failed", 3, "interrupted")
    assert seen["finished_at"]
    assert job(api, "job_unwanted")["state"] == "cancelled"


THREADS_AT_FIRST_LOAD = """
import sys
from fastapi.testclient import TestClient
from threadpoolctl import threadpool_info
from service.app import create_app
from service.foundation.settings import Settings
from service.storage.files import Files

def blas_threads():
    return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}

def load_version(*arguments, load=Files.load_version):
    print(*blas_threads())
    return load(*arguments)

Files.load_version = load_version
print(*blas_threads())
with TestClient(create_app(Settings(home=sys.argv[1]))):
    pass
"""
"""A service that prints the number of threads of BLAS before its start, and when it loads a model."""


@pytest.mark.slow
def test_blas_threads_are_limited_before_the_first_model_is_loaded(home):
    """With more threads, the service rounds a learnt state differently from the learner process."""
    command = [sys.executable, "-c", THREADS_AT_FIRST_LOAD, str(home)]
    environment = {**os.environ, **dict.fromkeys(THREAD_VARIABLES, "2")}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    before, *loaded = done.stdout.split()
    assert (before, set(loaded)) == ("2", {"1"})


def make_earlier_home(home, job):
    """Make a home whose newest version of the shipped model has an obsolete format."""
    database, files = Database.of(Settings(home=home)), Files(home)
    shipped.install_shipped(database, files)
    with database.transaction() as session:
        row = session.scalar(select(VersionRow))
        row.job, row.manifest = job, {**row.manifest, "format_version": 2, "tensors": {"sha256": "of another"}}
        path = files.versions / row.folder / "manifest.json"
        path.write_text(json.dumps(row.manifest))
    database.close()


def test_upgrade_adds_its_shipped_model(home):
    make_earlier_home(home, job=None)
    with start_service(home) as api:
        assert api.get("/v1/models/panda-sim").json()["latest_version"] == 2
        query = {"q": [0.0] * 7, "dq": [0.0] * 7, "ddq": [0.0] * 7}
        assert api.post("/v1/models/panda-sim/predict", json=query).json()["version"] == 2
        reply = error(api.post("/v1/models/panda-sim/predict", json=query | {"version": 1}), 500, "unreadable_version")
        assert "format_version is 2, expected 3: train the model again" in reply["message"]
        assert str(home) not in str(reply)
        assert api.get("/v1/models/panda-sim/versions/1").status_code == 200


@pytest.mark.slow
def test_upgrade_keeps_a_model_that_the_user_has_trained(home):
    make_earlier_home(home, job="job_of_the_user")
    with start_service(home) as api:
        assert api.get("/v1/models/panda-sim").json()["latest_version"] == 1


@pytest.mark.slow
def test_second_service_on_a_home_is_rejected(second_start):
    message = r"another service uses .*: stop it, or set LIPSERVE_HOME"
    with pytest.raises(HomeInUseError, match=message), start_service(second_start[-1]):
        pass


def test_second_service_is_rejected_if_the_lock_file_or_the_lock_of_the_folder_is_lost(home):
    with lock_home(home):
        (home / ".lock").unlink()
        with pytest.raises(HomeInUseError):
            lock_home(home)
    lock_home(home).close()
    with (home / ".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(HomeInUseError):
            lock_home(home)


def test_new_home_belongs_to_its_owner_alone(home):
    mask = os.umask(0)
    try:
        lock_home(home).close()
        Database.of(Settings(home=home)).close()
    finally:
        os.umask(mask)
    assert stat.S_IMODE(home.stat().st_mode) == 0o700
    assert {stat.S_IMODE(file.stat().st_mode) for file in home.glob("lipserve.sqlite3*")} == {0o600}


@pytest.mark.slow
def test_second_server_explains_why_it_exits(server, tmp_path):
    log = tmp_path / "second.log"
    second = Served(["serve", "--port", "0"], {**os.environ, "LIPSERVE_HOME": str(server.home)}, log)
    assert second.wait(DEADLINE) != 0
    assert f"another service uses {server.home}: stop it, or set LIPSERVE_HOME" in log.read_text()
    assert "Traceback" not in log.read_text()
