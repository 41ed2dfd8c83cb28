"""The quota of the home and the space that stays free on its disk."""

import os
import sqlite3
import time
from contextlib import closing, contextmanager
from types import SimpleNamespace

import pytest

import lipcore
from service.api.limits.upload import WRITE_BYTES
from service.foundation.errors import StorageFullError
from service.foundation.settings import Settings, shipped_models
from service.models import registry
from service.storage import disk as measuring
from service.storage.database import Database, RobotRow
from service.storage.database.engine import FILE, LOG_BYTES
from service.storage.disk import Disk, measure
from service.storage.files import new_id
from tests.service.data import QUICK, arrays, error, npz, post, service_of, stream

KiB = 1024


@pytest.fixture
def clock(monkeypatch):
    """Time that stands still until it is told to go on."""
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(time, "monotonic", lambda: clock.now)
    return clock


@pytest.fixture
def disk(tmp_path):
    """The disk of a home that holds 500 bytes of the 1000 that it may."""
    (tmp_path / "file").write_bytes(bytes(500))
    return Disk(Settings(home=tmp_path, max_home_bytes=1000, min_free_bytes=0))


def test_a_home_is_measured_with_all_below_it_but_not_what_links_lead_to(tmp_path):
    (tmp_path / "home" / "a" / "b").mkdir(parents=True)
    (tmp_path / "home" / "one").write_bytes(bytes(1000))
    (tmp_path / "home" / "a" / "b" / "two").write_bytes(bytes(200))
    (tmp_path / "outside").write_bytes(bytes(10_000))
    for link, target in (("file", "outside"), ("folder", ""), ("nothing", "nowhere")):
        (tmp_path / "home" / link).symlink_to(tmp_path / target)
    links = sum((tmp_path / "home" / link).lstat().st_size for link in ("file", "folder", "nothing"))
    assert measure(tmp_path / "home") == 1200 + links
    assert measure(tmp_path / "nowhere") == 0


def test_a_quota_is_kept_between_measurements(disk, clock):
    disk.reserve(300)
    disk.reserve(200)
    disk.require()
    with pytest.raises(StorageFullError, match=r"1000 bytes of 1000 bytes \(LIPSERVE_MAX_HOME_BYTES\)"):
        disk.reserve(1)
    clock.now = 2.0  # what was announced was not written, as a measurement shows
    disk.reserve(500)
    with pytest.raises(StorageFullError):
        disk.require(1)


def test_what_others_write_is_seen_after_a_while_and_what_they_delete_soon(disk, tmp_path, clock):
    disk.require(500)
    (tmp_path / "other").write_bytes(bytes(400))
    disk.require(500)
    clock.now = 2 * measuring.MEASURE_S
    with pytest.raises(StorageFullError):
        disk.require(500)
    (tmp_path / "other").unlink()
    with pytest.raises(StorageFullError):
        disk.require(500)
    clock.now += 2 * measuring.RECHECK_S
    disk.require(500)


def test_space_stays_free(tmp_path):
    free = os.statvfs(tmp_path).f_bavail * os.statvfs(tmp_path).f_frsize
    Disk(Settings(home=tmp_path, min_free_bytes=0)).require()
    disk = Disk(Settings(home=tmp_path, min_free_bytes=free * 2))
    with pytest.raises(StorageFullError, match="LIPSERVE_MIN_FREE_BYTES"):
        disk.require()
    assert disk.usage().shortage() is not None


@contextmanager
def nothing_comes(api, monkeypatch, room):
    """Let the session's service have no more room than this, and check that no file of a data set comes meanwhile."""
    service = service_of(api)

    def files():
        return sorted([*service.files.datasets.iterdir(), *service.files.uploads.iterdir()])

    before = files()
    with monkeypatch.context() as patch:
        patch.setattr(service.disk, "quota", service.disk.usage(0).used + room)
        yield
    assert files() == before


def test_what_is_stored_is_refused_before_it_is_read_while_queries_go_on(api, pendulum, monkeypatch):
    packed = npz(**arrays(stream()))
    job = {"model": "limits-full", "datasets": [pendulum["id"]], "estimator": "lip-chain", "options": QUICK}
    with nothing_comes(api, monkeypatch, room=-1):
        for answer in (
            post(api, packed),
            api.post("/v1/datasets", files={"file": ("full.npz", packed)}),
            api.post("/v1/jobs", json=job),
            api.post("/v1/robots", content=b"<robot/>", headers={"content-type": "application/xml"}),
        ):
            assert "LIPSERVE_MAX_HOME_BYTES" in error(answer, 507, "storage_full")["message"]
        query = {"q": [0.0] * 7, "dq": [0.0] * 7, "ddq": [0.0] * 7}
        assert api.post("/v1/models/panda-sim/predict", json=query).status_code == 200
        assert api.get("/v1/datasets").status_code == 200


def test_an_upload_of_unknown_length_is_ended_where_the_room_ends(api, monkeypatch):
    pieces = iter([bytes(64 * KiB)] * 64)
    with nothing_comes(api, monkeypatch, room=WRITE_BYTES + 1):
        error(post(api, pieces, "text/csv"), 507, "storage_full")


def test_data_that_is_larger_once_unpacked_is_refused(api, monkeypatch):
    packed = npz(**arrays(stream()))
    with nothing_comes(api, monkeypatch, room=len(packed) + 100):
        error(post(api, packed), 507, "storage_full")


def test_observations_are_refused_and_repeated_ones_are_still_known(api, monkeypatch):
    service, folder = service_of(api), new_id("mv")
    manifest = lipcore.copy_model(shipped_models() / "panda-sim", service.files.versions / folder)
    with service.database.transaction() as session:
        registry.publish(session, "limits-taught", folder, manifest, None)
    rows = {"dq": [[0.0] * 7] * 2, "ddq": [[0.0] * 7] * 2, "tau": [[0.0] * 7] * 2}
    body = {"stream_id": "limits-full", "sequence": 0, "t": [0.0, 0.01], "q": [[0.1] * 7] * 2, **rows}
    address = "/v1/models/limits-taught/observations"
    assert api.post(address, json=body).status_code == 200
    monkeypatch.setattr(service_of(api).disk, "quota", 1)
    assert api.post(address, json=body).json()["duplicate"] is True
    error(api.post(address, json=body | {"sequence": 1, "t": [0.02, 0.03]}), 507, "storage_full")


def test_a_state_without_room_is_not_stored_and_learning_goes_on(monkeypatch, caplog, tmp_path):
    from service.learning.learner.follower import Follower

    monkeypatch.setattr("service.learning.learner.follower.state.dump", lambda _: bytes(1000))
    follower = Follower.__new__(Follower)
    follower.model, follower.version, follower._stored = "limits", 1, 0
    follower.known = SimpleNamespace(number=5, settled=True, online=None)
    follower.settings = Settings(home=tmp_path, max_home_bytes=1)
    follower.disk, follower.snapshot_every_s = Disk(follower.settings), 60.0
    with closing(Database(tmp_path)) as follower.database:
        follower.store()
    assert "has learnt is not stored" in caplog.text
    assert follower._stored == 0
    assert time.monotonic() < follower.snapshot_due <= time.monotonic() + 60


def test_the_log_of_a_database_that_was_read_for_long_is_cut(tmp_path):
    """SQLite keeps all that is written while somebody reads; without a limit its file stays as large for good."""
    log, long = tmp_path / "lipserve.sqlite3-wal", "x" * 100_000

    def write(number: int) -> None:
        with database.transaction() as session:
            row = {"id": f"rb_{number}", "name": "arm", "created_at": "", "sha256": "", "joints": [], "urdf": long}
            session.add(RobotRow(**row))

    with closing(Database(tmp_path)) as database:
        with closing(sqlite3.connect(tmp_path / FILE)) as reader:
            reader.execute("BEGIN")
            reader.execute("SELECT count(*) FROM robots").fetchone()
            for number in range(100):
                write(number)
            assert log.stat().st_size > 2 * LOG_BYTES
        for number in range(100, 103):
            write(number)
        assert log.stat().st_size <= LOG_BYTES
