"""Damaged files: requests that need one fail with an error, and everything else works."""

import shutil
import sqlite3
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from lipcore.files.persistence import MANIFEST, TENSORS
from service.app import create_app
from service.cli.verify import verify_home
from service.foundation.settings import Settings
from service.storage.database.engine import FILE
from service.storage.storage import HomeError, check_home
from tests.service.data import error, eventually, stream, upload
from tests.system.faults.damage import HARM, cut, empty, flip, zero
from tests.system.faults.harness import populate_home
from tests.system.faults.ledger import ARM, Ledger, batch, list_items, predict_queries, query_rows

BATCHES = 12
ADDRESS = "http://127.0.0.1"
harm = pytest.mark.parametrize("harm", HARM, ids=lambda each: each.__name__)


@dataclass(frozen=True)
class UsedHome:
    """A home that was used, and its content. home_after_power_cut: a copy from the running service, whose database has
    an unmerged write-ahead log."""

    home: Path
    home_after_power_cut: Path
    datasets: list[str]
    ledger: Ledger


@contextmanager
def run_service(home):
    """Run a service on a home."""
    settings = Settings(home=home, publish_every_s=0.02, learner_niceness=0)
    with TestClient(create_app(settings), ADDRESS, raise_server_exceptions=False) as api:
        yield api


@pytest.fixture(scope="module")
def used_home(tmp_path_factory) -> UsedHome:
    home, home_after_power_cut, ledger = (
        tmp_path_factory.mktemp("lived") / "home",
        tmp_path_factory.mktemp("cut") / "home",
        Ledger(),
    )
    populate_home(home)
    with run_service(home) as api:
        datasets = [upload(api, stream(seed=seed))["id"] for seed in (5, 6)]
        for sequence in range(BATCHES):
            assert api.post(f"/v1/models/{ARM}/observations", json=batch(sequence)).status_code == 200
            ledger.batches[sequence] = "learnt"
            eventually(lambda at=sequence: predict_queries(api, ARM)["revision"] > at)
            if sequence >= BATCHES - 3:
                eventually(lambda at=sequence + 1: query_rows(home, f"SELECT id FROM snapshots WHERE number = {at}"))
        ledger.datasets = {each["id"]: each for each in list_items(api, "/v1/datasets")}
        shutil.copytree(home, home_after_power_cut)
    return UsedHome(home, home_after_power_cut, datasets, ledger)


@pytest.fixture
def home(used_home, tmp_path):
    """A copy of the used home."""
    return Path(shutil.copytree(used_home.home, tmp_path / "home"))


@pytest.fixture
def home_after_power_cut(used_home, tmp_path):
    """A copy of the used home as a power cut leaves it."""
    return Path(shutil.copytree(used_home.home_after_power_cut, tmp_path / "home"))


@pytest.mark.parametrize("file", [MANIFEST, TENSORS])
@harm
def test_damaged_version_leaves_other_versions_serving(used_home, home, file, harm):
    harm(home / "versions" / "mv_arm2" / file)
    with run_service(home) as api:
        assert api.get("/health/ready").status_code == 200
        query = {"q": [0.0, 0.0], "dq": [0.0, 0.0], "ddq": [0.0, 0.0]}
        error(api.post(f"/v1/models/{ARM}/predict", json=query | {"version": 2}), 500, "unreadable_version")
        assert predict_queries(api, ARM)["version"] == 1
        error(api.post(f"/v1/models/{ARM}/rollback", json={"version": 2}), 500, "unreadable_version")
        assert api.get(f"/v1/models/{ARM}").json()["serving_version"] == 1
        assert predict_queries(api, ARM)["version"] == 1


def test_damaged_serving_version_leaves_other_models_serving(used_home, home):
    flip(home / "versions" / "mv_arm1" / TENSORS)
    with run_service(home) as api:
        query = {"q": [0.0, 0.0], "dq": [0.0, 0.0], "ddq": [0.0, 0.0]}
        error(api.post(f"/v1/models/{ARM}/predict", json=query), 500, "unreadable_version")
        zeros = {name: [0.0] * 7 for name in ("q", "dq", "ddq")}
        assert api.post("/v1/models/panda-sim/predict", json=zeros).status_code == 200
        assert api.post(f"/v1/models/{ARM}/rollback", json={"version": 2}).status_code == 200
        assert predict_queries(api, ARM)["version"] == 2


def test_damaged_log_rows_are_not_learnt(used_home, home):
    with closing(sqlite3.connect(home / FILE)) as database:
        database.execute("UPDATE events SET payload = substr(payload, 1, 100) WHERE number = 3")
        database.execute("DELETE FROM snapshots")
        database.commit()
    with run_service(home) as api:
        assert predict_queries(api, ARM)["version"] == 1
        for sequence in (BATCHES, BATCHES + 1):
            assert api.post(f"/v1/models/{ARM}/observations", json=batch(sequence)).status_code == 200
        failed = eventually(lambda: api.get(f"/v1/models/{ARM}/learning").json()["status"]["failure"])
        assert "logged rows cannot be read" in failed
        assert api.get("/health/live").status_code == 200


@pytest.mark.parametrize("harm", [cut, empty, zero], ids=lambda each: each.__name__)
def test_service_rejects_damaged_database_with_advice(home, harm):
    path = home / FILE
    size = path.stat().st_size
    harm(path)
    if harm is empty:  # an empty database counts as a new one
        check_home(Settings(home=home))
        return
    with pytest.raises(HomeError, match=r"the database .*lipserve.sqlite3 cannot be used: .*\.recover.*LIPSERVE_HOME"):
        check_home(Settings(home=home))
    assert path.stat().st_size in (size, size // 2)  # the file is not changed, so that data can be recovered from it


@pytest.mark.parametrize("part", [0.0, 0.3, 0.7, 0.95, 0.999])
def test_power_cut_during_commit_loses_only_end_of_log(used_home, home_after_power_cut, part):
    """The disk loses synced data: the last transactions are lost as a whole, and all earlier ones remain."""
    journal = home_after_power_cut / f"{FILE}-wal"
    with journal.open("r+b") as file:
        file.truncate(int(journal.stat().st_size * part))
    check_home(Settings(home=home_after_power_cut))
    found = verify_home(Settings(home=home_after_power_cut))  # files may be lost with the rows that deleted them
    assert {each.kind for each in found.damages} <= {"snapshot"}
    left = [
        row[0]
        for row in query_rows(home_after_power_cut, "SELECT sequence FROM events WHERE kind = 'batch' ORDER BY number")
    ]
    assert left == list(range(len(left)))
    known = {row[0] for row in query_rows(home_after_power_cut, "SELECT id FROM datasets")}
    assert known <= set(used_home.datasets)
