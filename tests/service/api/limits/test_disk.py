"""The quota of the home, and the space that stays free on its disk."""

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
from service.storage import disk as measuring
from service.storage.database import Database, RobotRow
from service.storage.database.engine import FILE, LOG_BYTES
from service.storage.disk import Disk, measure
from tests.service.data import QUICK, arrays, error, npz, post, service_of, stream
from tests.service.models.versions import publish

KiB = 1024


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands still until the test moves it."""
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(time, "monotonic", lambda: clock.now)
    return clock


@pytest.fixture
def disk(tmp_path):
    """The disk of a home that contains 500 of at most 1000 bytes."""
    (tmp_path / "file").write_bytes(bytes(500))
    return Disk(Settings(home=tmp_path, max_home_bytes=1000, min_free_bytes=0))


def test_usage_of_a_home_excludes_link_targets(tmp_path, home):
    (home / "a" / "b").mkdir(parents=True)
    for file, size in ((home / "one", 1000), (home / "a" / "b" / "two", 200), (tmp_path / "outside", 10_000)):
        file.write_bytes(bytes(size))
    links = {home / "file": "outside", home / "folder": "", home / "nothing": "nowhere"}
    for link, target in links.items():
        link.symlink_to(tmp_path / target)
    assert measure(home) == 1200 + sum(link.lstat().st_size for link in links)
    assert measure(tmp_path / "nowhere") == 0


def test_quota_holds_between_measurements(disk, clock):
    disk.reserve(300)
    disk.reserve(200)
    disk.require()
    with pytest.raises(StorageFullError, match=r"1000 bytes of 1000 bytes in use \(LIPSERVE_MAX_HOME_BYTES\)"):
        disk.reserve(1)
    clock.now = 2.0  # a measurement shows that the reserved bytes were not written
    disk.reserve(500)
    with pytest.raises(StorageFullError):
        disk.require(1)


def test_writes_and_deletions_of_others_are_measured(disk, tmp_path, clock):
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


def test_min_free_space_is_kept(tmp_path):
    free = os.statvfs(tmp_path).f_bavail * os.statvfs(tmp_path).f_frsize
    Disk(Settings(home=tmp_path, min_free_bytes=0)).require()
    disk = Disk(Settings(home=tmp_path, min_free_bytes=free * 2))
    with pytest.raises(StorageFullError, match="LIPSERVE_MIN_FREE_BYTES"):
        disk.require()
    assert disk.usage().shortage() is not None


@contextmanager
def assert_nothing_stored(api, monkeypatch, room):
    """Leave the session's service this much room, and check that it stores no file of a data set."""
    service = service_of(api)

    def files():
        return sorted([*service.files.datasets.iterdir(), *service.files.uploads.iterdir()])

    before = files()
    with monkeypatch.context() as patch:
        patch.setattr(service.disk, "quota", service.disk.usage(0).used + room)
        yield
    assert files() == before


def test_full_disk_rejects_writes_and_answers_queries(api, pendulum, monkeypatch):
    packed = npz(**arrays(stream()))
    job = {"model": "limits-full", "datasets": [pendulum["id"]], "estimator": "lip-chain", "options": QUICK}
    with assert_nothing_stored(api, monkeypatch, room=-1):
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


def test_upload_of_unknown_length_stops_at_the_quota(api, monkeypatch):
    pieces = iter([bytes(64 * KiB)] * 64)
    with assert_nothing_stored(api, monkeypatch, room=WRITE_BYTES + 1):
        error(post(api, pieces, "text/csv"), 507, "storage_full")


def test_unpacked_data_must_fit_the_quota(api, monkeypatch):
    packed = npz(**arrays(stream()))
    with assert_nothing_stored(api, monkeypatch, room=len(packed) + 100):
        error(post(api, packed), 507, "storage_full")


def test_full_disk_rejects_observations_but_knows_repeated_ones(api, monkeypatch):
    publish(api, "limits-taught", lipcore.load(shipped_models() / "panda-sim"))
    rows = {name: [[0.1] * 7] * 2 for name in ("q", "dq", "ddq", "tau")}
    body = {"stream_id": "limits-full", "sequence": 0, "t": [0.0, 0.01], **rows}
    address = "/v1/models/limits-taught/observations"
    assert api.post(address, json=body).status_code == 200
    monkeypatch.setattr(service_of(api).disk, "quota", 1)
    assert api.post(address, json=body).json()["duplicate"] is True
    error(api.post(address, json=body | {"sequence": 1, "t": [0.02, 0.03]}), 507, "storage_full")


def test_learning_continues_without_room_for_snapshots(monkeypatch, caplog, tmp_path):
    from service.learning.learner.follower import Follower

    monkeypatch.setattr("service.learning.learner.follower.state.dump", lambda _: bytes(1000))
    follower = Follower.__new__(Follower)
    follower.model, follower.version, follower._stored = "limits", 1, 0
    follower.known = SimpleNamespace(number=5, settled=True, online=None)
    follower.settings = Settings(home=tmp_path, max_home_bytes=1)
    follower.disk, follower.snapshot_every_s = Disk(follower.settings), 60.0
    with closing(Database(tmp_path)) as follower.database:
        follower.store()
    assert "could not store the state of version" in caplog.text
    assert follower._stored == 0
    assert time.monotonic() < follower.snapshot_due <= time.monotonic() + 60


def test_write_ahead_log_is_truncated_after_a_long_read(tmp_path):
    """SQLite keeps all writes while somebody reads; without a limit the file stays as large for ever."""
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
