"""A home of release 0.2.0 opens with this one: it serves the same torques and goes on learning; nothing is lost."""

import json
import sqlite3
import tarfile
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient

import lipcore
from lipcore.data import independence
from lipcore.online.batch import Rows
from lipcore.online.learner import OnlineModel
from lipcore.vocabulary import Code
from service.api.access import keys
from service.app import create_app
from service.cli.verify import verify_home
from service.foundation.settings import Settings
from service.storage.backup import backup, restore
from service.storage.database import Database
from service.storage.database.migrations import HEAD
from tests.service.access.conftest import bearer
from tests.service.data import QUICK, ended, eventually, queue

pytestmark = pytest.mark.own_files("a home of a service alone")
HERE = Path(__file__).parent
RELEASE = "0.2.0"
TOLD = json.loads((HERE / f"home-{RELEASE}.json").read_text())
"""What that release answered, see `make_home.py`: queries, answers, the lessons that it was taught, the first four, and
others that it was not."""
TAUGHT = 4
TAKEN_BACK = 1
CLOSE, LEARNT_CLOSE = 1e-9, 1e-7
"""Largest difference of torques, of the largest: as trained, and where what was learnt is solved for anew."""


def unpacked(folder):
    home = folder / "home"
    with tarfile.open(HERE / f"home-{RELEASE}.tar.xz") as tar:
        tar.extractall(home, filter="data")
    return home


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """A service of this release on that home, and a client that may everything."""
    home = unpacked(tmp_path_factory.mktemp("upgraded"))
    settings = Settings(home=home, keys="on", publish_every_s=0.02)
    database = Database.of(settings)  # the first to open it: this migrates
    _, secret = keys.create(database, "owner", ["admin"], None)
    database.close()
    with TestClient(create_app(settings), "http://robot.example", headers=bearer(secret)) as api:
        yield api, home


def predicted(api, model, **more):
    answer = api.post(f"/v1/models/{model}/predict", json={**TOLD["queries"], **more})
    assert answer.status_code == 200, answer.text
    return answer.json()


def check_same(found, told):
    close_to = LEARNT_CLOSE if told["revision"] else CLOSE
    assert [found[name] for name in ("version", "revision", "joint_names", "torque_convention")] == [
        told[name] for name in ("version", "revision", "joint_names", "torque_convention")
    ]
    for name, close in (("tau", close_to), ("tau_std", close_to), ("noise_std", CLOSE)):
        expected = np.array(told[name])
        assert np.abs(np.array(found[name]) - expected).max() <= close * np.abs(expected).max(), name


def test_the_home_is_of_that_release_and_is_migrated(tmp_path):
    assert TOLD["release"] == RELEASE
    home = unpacked(tmp_path)

    def revision():
        with closing(sqlite3.connect(home / "lipserve.sqlite3")) as database:
            return database.execute("SELECT version_num FROM alembic_version").fetchone()[0]

    assert revision() == "0004"
    Database.of(Settings(home=home)).close()
    assert revision() == HEAD


@pytest.mark.parametrize("name", ["chain", "bodies", "chain@production"])
def test_the_same_torques_are_served(opened, name):
    api, _ = opened
    model, _, alias = name.partition("@")
    told = TOLD["answers"][name]
    chosen = {"alias": alias} if alias else {"version": told["version"], "min_revision": told["revision"]}
    check_same(predicted(api, model, **chosen), told)


def test_models_data_sets_keys_and_the_log_are_there(opened):
    api, home = opened
    for model, told in TOLD["models"].items():
        found = api.get(f"/v1/models/{model}").json()
        for version in found["versions"]:  # later releases say more of a version
            assert version.pop("quality") is None
            assert version.pop("promotion")["reason"] == "not judged, as nothing was held out"
        assert found == told
    assert [each["id"] for each in api.get("/v1/datasets").json()["items"]] == [TOLD["dataset"]]
    old = bearer(TOLD["key"]["secret"])
    assert api.post("/v1/models/chain/predict", json=TOLD["queries"], headers=old).status_code == 200
    assert api.post("/v1/models/chain/refresh", json={}, headers=old).status_code == 403
    sent = [api.post("/v1/models/chain/observations", json=each).json() for each in TOLD["lessons"][:TAUGHT]]
    assert [each["duplicate"] for each in sent] == [True] * TAUGHT
    assert [each["state"] for each in sent] == ["learnt", "unlearnt", "learnt", "learnt"]
    assert verify_home(Settings(home=home)).damages == []


def test_a_backup_of_the_home_as_it_was_is_opened_too(tmp_path):
    made = backup(unpacked(tmp_path), tmp_path / "b.tar")
    assert (made.datasets, made.versions, made.observations) == (1, 3, 2 * TAUGHT)
    restore(tmp_path / "back", tmp_path / "b.tar")
    assert verify_home(Settings(home=tmp_path / "back")).damages == []


def learnt(home, count):
    """What version 2 of `chain` predicts that has learnt the first lessons in one go, but for the one taken back."""
    with closing(sqlite3.connect(home / "lipserve.sqlite3")) as database:
        query = "SELECT folder FROM versions WHERE model = 'chain' AND version = 2"
        base = lipcore.load(home / "versions" / database.execute(query).fetchone()[0])
    lessons = TOLD["lessons"][:count]
    times = np.concatenate([each["t"] for each in lessons])
    numbers = [np.concatenate([each[name] for each in lessons]) for name in ("q", "dq", "ddq", "tau")]
    every = Rows(times, *numbers, np.full(len(times), Code.LEARNT, np.uint8), independence.even_weights(times))
    size = len(times) // count
    kept = np.flatnonzero(np.arange(len(times)) // size != TAKEN_BACK)
    model = OnlineModel.start(base).learn(every.take(kept)).model()
    return np.asarray(model.predict(*(np.array(TOLD["queries"][name]) for name in ("q", "dq", "ddq"))).tau)


def test_it_goes_on_learning_where_it_was(opened):
    api, home = opened
    said = [api.post("/v1/models/chain/observations", json=each) for each in TOLD["lessons"][TAUGHT:]]
    assert [each.status_code for each in said] == [200] * len(said)
    assert {each.json()["state"] for each in said} == {"learnt"}
    revision = said[-1].json()["revision"]
    assert revision == TOLD["answers"]["chain"]["revision"] + len(said)
    found = eventually(lambda: (seen := predicted(api, "chain"))["revision"] >= revision and seen)
    expected = learnt(home, len(TOLD["lessons"]))
    assert np.abs(np.array(found["tau"]) - expected).max() <= LEARNT_CLOSE * np.abs(expected).max()
    before = np.array(TOLD["answers"]["chain"]["tau"])
    assert np.abs(np.array(found["tau"]) - before).max() > 1e-6
    # and back again, to what 0.2.0 had learnt
    told = TOLD["answers"]["chain"]
    back = api.post("/v1/models/chain/rollback", json={"revision": told["revision"]})
    assert back.status_code == 200, back.text
    again = eventually(lambda: (seen := predicted(api, "chain"))["revision"] > revision and seen)
    check_same({**again, "revision": told["revision"]}, told)


def test_what_was_recorded_then_can_be_trained_on_and_the_audit_log_begins(opened):
    api, _ = opened
    job = ended(api, queue(api, "anew", TOLD["dataset"], options=QUICK)["id"])
    assert (job["state"], job["version"]) == ("succeeded", 1)
    lines = api.get("/v1/audit?model=anew").json()["items"]
    assert [each["change"] for each in lines] == ["alias moved", "version added"]
    assert {each["key_name"] for each in lines} == {"owner"}
    moved = api.post("/v1/models/chain/aliases/production/rollback")
    assert moved.status_code == 409  # it has pointed to nothing before, which that release has noted
