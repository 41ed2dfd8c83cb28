"""Upgrade of a home of release 0.2.0: it serves the same torques, continues to learn, and loses nothing."""

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
from tests import unpack
from tests.service.api.access.conftest import bearer
from tests.service.data import QUICK, ended, eventually, queue

pytestmark = [pytest.mark.own_files("a home of a service alone"), pytest.mark.journey]
HERE = Path(__file__).parent
RELEASE = "0.2.0"
RECORDED = json.loads((HERE / f"home-{RELEASE}.json").read_text())
"""What that release answered, see `make_home.py`: queries, answers, the batches that it has learnt, and further
ones."""
SENT_BATCHES = 4
UNLEARNT_BATCH = 1
MAX_DIFFERENCE, MAX_LEARNT_DIFFERENCE = 1e-9, 1e-7
"""Largest relative difference of torques: as trained, and where learnt parameters are solved again."""


def unpack_home(folder):
    home = folder / "home"
    with tarfile.open(HERE / f"home-{RELEASE}.tar.xz") as tar:
        unpack(tar, home)
    return home


@pytest.fixture(scope="module")
def upgraded(tmp_path_factory):
    """A service of this release on that home, and a client with all rights."""
    home = unpack_home(tmp_path_factory.mktemp("upgraded"))
    settings = Settings(home=home, keys="on", publish_every_s=0.02)
    database = Database.of(settings)  # opening the database migrates it
    _, secret = keys.create(database, "owner", ["admin"], None)
    database.close()
    with TestClient(create_app(settings), "http://robot.example", headers=bearer(secret)) as api:
        yield api, home


def predict_queries(api, model, **more):
    answer = api.post(f"/v1/models/{model}/predict", json={**RECORDED["queries"], **more})
    assert answer.status_code == 200, answer.text
    return answer.json()


def check_same(found, recorded):
    close_to = MAX_LEARNT_DIFFERENCE if recorded["revision"] else MAX_DIFFERENCE
    assert [found[name] for name in ("version", "revision", "joint_names", "torque_convention")] == [
        recorded[name] for name in ("version", "revision", "joint_names", "torque_convention")
    ]
    for name, close in (("tau", close_to), ("tau_std", close_to), ("noise_std", MAX_DIFFERENCE)):
        expected = np.array(recorded[name])
        assert np.abs(np.array(found[name]) - expected).max() <= close * np.abs(expected).max(), name


def test_home_is_migrated(tmp_path):
    assert RECORDED["release"] == RELEASE
    home = unpack_home(tmp_path)

    def revision():
        with closing(sqlite3.connect(home / "lipserve.sqlite3")) as database:
            return database.execute("SELECT version_num FROM alembic_version").fetchone()[0]

    assert revision() == "0004"
    Database.of(Settings(home=home)).close()
    assert revision() == HEAD


@pytest.mark.parametrize("name", ["chain", "bodies", "chain@production"])
def test_served_torques_are_unchanged(upgraded, name):
    api, _ = upgraded
    model, _, alias = name.partition("@")
    recorded = RECORDED["answers"][name]
    chosen = {"alias": alias} if alias else {"version": recorded["version"], "min_revision": recorded["revision"]}
    check_same(predict_queries(api, model, **chosen), recorded)


def test_models_datasets_keys_and_log_are_kept(upgraded):
    api, home = upgraded
    for model, recorded in RECORDED["models"].items():
        found = api.get(f"/v1/models/{model}").json()
        assert found.pop("thresholds") == {"max_error": 0.9, "min_coverage": 0.9, "max_width": 1.0}
        for version in found["versions"]:  # fields of later releases
            assert version.pop("verdict")["level"] == "not_judged"
            assert version.pop("promotion")["reason"] == "not judged, as nothing was held out"
            assert (version.pop("note"), version.pop("tags")) == (None, [])
        assert found == recorded
    assert [each["id"] for each in api.get("/v1/datasets").json()["items"]] == [RECORDED["dataset"]]
    old = bearer(RECORDED["key"]["secret"])
    assert api.post("/v1/models/chain/predict", json=RECORDED["queries"], headers=old).status_code == 200
    assert api.post("/v1/models/chain/refresh", json={}, headers=old).status_code == 403
    sent = [api.post("/v1/models/chain/observations", json=each).json() for each in RECORDED["lessons"][:SENT_BATCHES]]
    assert [each["duplicate"] for each in sent] == [True] * SENT_BATCHES
    assert [each["state"] for each in sent] == ["learnt", "unlearnt", "learnt", "learnt"]
    assert verify_home(Settings(home=home)).damages == []


def test_backup_of_old_home_is_restored(tmp_path):
    made = backup(unpack_home(tmp_path), tmp_path / "b.tar")
    assert (made.datasets, made.versions, made.observations) == (1, 3, 2 * SENT_BATCHES)
    restore(tmp_path / "back", tmp_path / "b.tar")
    assert verify_home(Settings(home=tmp_path / "back")).damages == []


def predict_expected(home, count):
    """Return the predictions of version 2 of `chain` after learning the first batches at once, without the undone
    one."""
    with closing(sqlite3.connect(home / "lipserve.sqlite3")) as database:
        query = "SELECT folder FROM versions WHERE model = 'chain' AND version = 2"
        base = lipcore.load(home / "versions" / database.execute(query).fetchone()[0])
    lessons = RECORDED["lessons"][:count]
    times = np.concatenate([each["t"] for each in lessons])
    numbers = [np.concatenate([each[name] for each in lessons]) for name in ("q", "dq", "ddq", "tau")]
    every = Rows(times, *numbers, np.full(len(times), Code.LEARNT, np.uint8), independence.even_weights(times))
    size = len(times) // count
    kept = np.flatnonzero(np.arange(len(times)) // size != UNLEARNT_BATCH)
    model = OnlineModel.start(base).learn(every.take(kept)).model()
    return np.asarray(model.predict(*(np.array(RECORDED["queries"][name]) for name in ("q", "dq", "ddq"))).tau)


def test_learning_continues_from_old_state(upgraded):
    api, home = upgraded
    responses = [api.post("/v1/models/chain/observations", json=each) for each in RECORDED["lessons"][SENT_BATCHES:]]
    assert [each.status_code for each in responses] == [200] * len(responses)
    assert {each.json()["state"] for each in responses} == {"learnt"}
    revision = responses[-1].json()["revision"]
    assert revision == RECORDED["answers"]["chain"]["revision"] + len(responses)
    found = eventually(lambda: (seen := predict_queries(api, "chain"))["revision"] >= revision and seen)
    expected = predict_expected(home, len(RECORDED["lessons"]))
    assert np.abs(np.array(found["tau"]) - expected).max() <= MAX_LEARNT_DIFFERENCE * np.abs(expected).max()
    before = np.array(RECORDED["answers"]["chain"]["tau"])
    assert np.abs(np.array(found["tau"]) - before).max() > 1e-6
    # roll back to what 0.2.0 had learnt
    recorded = RECORDED["answers"]["chain"]
    back = api.post("/v1/models/chain/rollback", json={"revision": recorded["revision"]})
    assert back.status_code == 200, back.text
    again = eventually(lambda: (seen := predict_queries(api, "chain"))["revision"] > revision and seen)
    check_same({**again, "revision": recorded["revision"]}, recorded)


def test_old_dataset_is_trained_on_and_audit_log_starts(upgraded):
    api, _ = upgraded
    job = ended(api, queue(api, "anew", RECORDED["dataset"], options=QUICK)["id"])
    assert (job["state"], job["version"]) == ("succeeded", 1)
    lines = api.get("/v1/audit?model=anew").json()["items"]
    assert [each["change"] for each in lines] == ["alias moved", "version added"]
    assert {each["key_name"] for each in lines} == {"owner"}
    moved = api.post("/v1/models/chain/aliases/production/rollback")
    assert moved.status_code == 409  # release 0.2.0 kept no history of the alias
