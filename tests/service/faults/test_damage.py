"""Damaged files of every kind: who needs one is told, and everything else goes on."""

import shutil
import sqlite3
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from lipcore.files.persistence import MANIFEST, TENSORS
from service.app import create_app
from service.foundation.settings import Settings
from service.storage.database.engine import FILE
from service.storage.storage import HomeError, check_home
from tests.service.data import error, eventually, stream, upload
from tests.service.faults.damage import HARM, cut, empty, flip, zero
from tests.service.faults.house import furnish
from tests.service.faults.ledger import ARM, Ledger, batch, listed, predicted, rows, verify_database

pytestmark = pytest.mark.slow
BATCHES = 12
ADDRESS = "http://127.0.0.1"
harm = pytest.mark.parametrize("harm", HARM, ids=lambda each: each.__name__)


@dataclass(frozen=True)
class Lived:
    """A home after some life, and what it holds. powerless: a copy from while the service ran, with the log of SQLite's
    writes that it had not brought into the database yet."""

    home: Path
    powerless: Path
    datasets: list[str]
    ledger: Ledger


@contextmanager
def running(home):
    """A service on a home."""
    settings = Settings(home=home, publish_every_s=0.02, learner_niceness=0)
    with TestClient(create_app(settings), ADDRESS, raise_server_exceptions=False) as api:
        yield api


@pytest.fixture(scope="module")
def lived(tmp_path_factory) -> Lived:
    home, powerless, ledger = (
        tmp_path_factory.mktemp("lived") / "home",
        tmp_path_factory.mktemp("cut") / "home",
        Ledger(),
    )
    furnish(home)
    with running(home) as api:
        datasets = [upload(api, stream(seed=seed))["id"] for seed in (5, 6)]
        for sequence in range(BATCHES):
            assert api.post(f"/v1/models/{ARM}/observations", json=batch(sequence)).status_code == 200
            ledger.batches[sequence] = "learnt"
            eventually(lambda at=sequence: predicted(api, ARM)["revision"] > at)
            if sequence >= BATCHES - 3:
                eventually(lambda at=sequence + 1: rows(home, f"SELECT id FROM snapshots WHERE number = {at}"))
        ledger.datasets = {each["id"]: each for each in listed(api, "/v1/datasets")}
        shutil.copytree(home, powerless)
    return Lived(home, powerless, datasets, ledger)


@pytest.fixture
def home(lived, tmp_path):
    """A copy of that home."""
    return Path(shutil.copytree(lived.home, tmp_path / "home"))


@pytest.fixture
def powerless(lived, tmp_path):
    """A copy of the home as a power cut leaves it."""
    return Path(shutil.copytree(lived.powerless, tmp_path / "home"))


@pytest.mark.parametrize("file", [MANIFEST, TENSORS])
@harm
def test_a_damaged_version_does_not_keep_others_from_answering(lived, home, file, harm):
    harm(home / "versions" / "mv_arm2" / file)
    with running(home) as api:
        assert api.get("/health/ready").status_code == 200
        query = {"q": [0.0, 0.0], "dq": [0.0, 0.0], "ddq": [0.0, 0.0]}
        error(api.post(f"/v1/models/{ARM}/predict", json=query | {"version": 2}), 500, "unreadable_version")
        assert predicted(api, ARM)["version"] == 1
        error(api.post(f"/v1/models/{ARM}/rollback", json={"version": 2}), 500, "unreadable_version")
        assert api.get(f"/v1/models/{ARM}").json()["serving_version"] == 1
        assert predicted(api, ARM)["version"] == 1


def test_where_the_version_that_serves_is_damaged_other_models_answer(lived, home):
    flip(home / "versions" / "mv_arm1" / TENSORS)
    with running(home) as api:
        query = {"q": [0.0, 0.0], "dq": [0.0, 0.0], "ddq": [0.0, 0.0]}
        error(api.post(f"/v1/models/{ARM}/predict", json=query), 500, "unreadable_version")
        zeros = {name: [0.0] * 7 for name in ("q", "dq", "ddq")}
        assert api.post("/v1/models/panda-sim/predict", json=zeros).status_code == 200
        assert api.post(f"/v1/models/{ARM}/rollback", json={"version": 2}).status_code == 200
        assert predicted(api, ARM)["version"] == 2


def test_rows_of_the_log_that_are_damaged_are_not_learnt_and_stop_nothing_else(lived, home):
    with closing(sqlite3.connect(home / FILE)) as database:
        database.execute("UPDATE events SET payload = substr(payload, 1, 100) WHERE number = 3")
        database.execute("DELETE FROM snapshots")
        database.commit()
    with running(home) as api:
        assert predicted(api, ARM)["version"] == 1
        for sequence in (BATCHES, BATCHES + 1):
            assert api.post(f"/v1/models/{ARM}/observations", json=batch(sequence)).status_code == 200
        failed = eventually(lambda: api.get(f"/v1/models/{ARM}/learning").json()["status"]["failure"])
        assert "logged rows cannot be read" in failed
        assert api.get("/health/live").status_code == 200


@pytest.mark.parametrize("harm", [cut, empty, zero], ids=lambda each: each.__name__)
def test_no_service_starts_on_a_damaged_database_and_it_says_what_would_help(home, harm):
    path = home / FILE
    size = path.stat().st_size
    harm(path)
    if harm is empty:  # as good as a new one: what is lost is seen by who looks for it
        check_home(Settings(home=home))
        return
    with pytest.raises(HomeError, match=r"the database .*lipserve.sqlite3 cannot be used: .*\.recover.*LIPSERVE_HOME"):
        check_home(Settings(home=home))
    assert path.stat().st_size in (size, size // 2)  # it is left as it was found, for who may save something


@pytest.mark.parametrize("part", [0.0, 0.3, 0.7, 0.95, 0.999])
def test_a_power_cut_in_the_middle_of_a_commit_loses_the_end_of_the_log_at_most(lived, powerless, part):
    """A disk that broke its promise: the last transactions are gone as a whole, and all before are there."""
    journal = powerless / f"{FILE}-wal"
    with journal.open("r+b") as file:
        file.truncate(int(journal.stat().st_size * part))
    check_home(Settings(home=powerless))
    verify_database(powerless)
    left = [row[0] for row in rows(powerless, "SELECT sequence FROM events WHERE kind = 'batch' ORDER BY number")]
    assert left == list(range(len(left)))
    known = {row[0] for row in rows(powerless, "SELECT id FROM datasets")}
    assert known <= set(lived.datasets)
