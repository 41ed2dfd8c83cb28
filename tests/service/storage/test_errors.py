"""Errors of storage: real errors of databases and operating systems, and the answers that clients get."""

import errno
import os
import shutil
import sqlite3
import subprocess
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from unittest.mock import patch

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import JSON, String, create_engine, event, text
from sqlalchemy.exc import DBAPIError

from service.app import create_app
from service.foundation.errors import ServiceError, StorageFullError, StorageUnavailableError
from service.foundation.settings import Settings
from service.learning.weigher.weighing import Weighing
from service.storage.database import Base, Database
from service.storage.database.engine import FILE
from service.storage.errors import translate_error
from service.storage.files import Files
from service.storage.storage import HomeError, check_home
from tests.service.data import ADDRESS, DEADLINE, arrays, error, npz, post, service_of, stream, upload
from tests.service.robots.test_robots import urdf
from tests.service.warm import Served
from tests.system.faults.storage import small_disk

ZERO = {name: [0.0] * 7 for name in ("q", "dq", "ddq")}


TABLE = "CREATE TABLE t (x PRIMARY KEY); INSERT INTO t VALUES (1)"
INSERT, SELECT = "INSERT INTO t VALUES (2)", "SELECT x FROM t WHERE x = 1"


def statement_error(path: Path, *statements: str, mode: str = "rwc") -> DBAPIError:
    """Run statements on a database; return the error of the last one."""
    engine = create_engine(f"sqlite:///file:{path}?mode={mode}&uri=true", connect_args={"timeout": 0})

    def run() -> None:
        with engine.connect() as connection:
            for statement in statements:
                result = connection.execute(text(statement))
                if result.returns_rows:
                    result.all()

    with pytest.raises(DBAPIError) as found:
        run()
    engine.dispose()
    return found.value


def locked_error(path: Path) -> DBAPIError:
    with locked(path):
        return statement_error(path, INSERT)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Lock a database for other writers."""
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        yield


def damaged_error(path: Path) -> DBAPIError:
    content = path.read_bytes()
    path.write_bytes(content[:4096] + os.urandom(len(content) - 4096))
    return statement_error(path, SELECT)


def no_database_error(path: Path) -> DBAPIError:
    path.write_bytes(b"no database" * 1000)
    return statement_error(path, SELECT)


def undecodable_error(path: Path) -> DBAPIError:
    return statement_error(path, "UPDATE t SET x = CAST(x'ff' AS TEXT)", "SELECT x FROM t")


def full_error(path: Path) -> DBAPIError:
    return statement_error(path, "PRAGMA max_page_count = 3", "INSERT INTO t VALUES (zeroblob(100000))")


@pytest.mark.parametrize(
    ("fail", "expected", "words"),
    [
        (locked_error, StorageUnavailableError, "locked by another writer"),
        (full_error, StorageFullError, "full"),
        (damaged_error, StorageUnavailableError, "damaged"),
        (no_database_error, StorageUnavailableError, "damaged"),
        (undecodable_error, StorageUnavailableError, "damaged"),
        (lambda path: statement_error(path, INSERT, mode="ro"), StorageUnavailableError, "readonly"),
        (lambda path: statement_error(path.parent, SELECT), StorageUnavailableError, "unable to open"),
        (lambda path: statement_error(path, "INSERT INTO t VALUES (1)"), None, ""),
    ],
)
def test_database_errors_are_classified(tmp_path, fail: Callable, expected: type[ServiceError] | None, words: str):
    with closing(sqlite3.connect(tmp_path / "database")) as database:
        database.executescript(TABLE)
    found = translate_error(fail(tmp_path / "database"))
    assert type(found) is (expected or type(None))
    assert found is None or words in found.message


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (errno.EDQUOT, StorageFullError),
        (errno.EFBIG, StorageFullError),
        (errno.EROFS, StorageUnavailableError),
        (errno.EIO, StorageUnavailableError),
        (errno.EACCES, StorageUnavailableError),
        (errno.EMFILE, StorageUnavailableError),
        (errno.ECONNRESET, None),
        (errno.ENOENT, None),
    ],
)
def test_system_errors_are_classified(number, expected):
    assert type(translate_error(OSError(number, os.strerror(number)))) is (expected or type(None))


@pytest.fixture(scope="module")
def service(tmp_path_factory) -> Iterator[TestClient]:
    """A service whose requests wait only briefly for the database."""
    app = create_app(Settings(home=tmp_path_factory.mktemp("storage")))
    with (
        patch("service.storage.storage.WAIT_S", 0.1),
        TestClient(app, "http://127.0.0.1", raise_server_exceptions=False) as api,
    ):
        yield api


def upload_dataset(api):
    return post(api, npz(**arrays(stream(samples=60))))


def upload_robot(api, content=None):
    return api.post("/v1/robots", content=content or urdf("late"), headers={"content-type": "application/xml"})


def set_alias(api):
    return api.put("/v1/models/panda-sim/aliases/production", json={"version": 1})


def assert_reads_work(api):
    assert api.post("/v1/models/panda-sim/predict", json=ZERO).status_code == 200
    for path in ("/v1/models", "/v1/datasets", "/health/live"):
        assert api.get(path).status_code == 200


def test_locked_database_gives_503_and_retry_after(service):
    with locked(service_of(service).settings.home / FILE):
        for request in (upload_dataset, upload_robot, set_alias):
            answer = request(service)
            error(answer, 503, "storage_unavailable")
            assert answer.headers["retry-after"] == "1"
        assert_reads_work(service)
        stored = [path for path in service_of(service).settings.home.glob("[du]*/*") if path.is_file()]
        assert stored == []  # nothing of the rejected requests was stored
    for request, status in ((upload_dataset, 201), (upload_robot, 201), (set_alias, 200)):
        assert request(service).status_code == status
    for each in service.get("/v1/datasets").json()["items"]:
        assert service.delete(f"/v1/datasets/{each['id']}").status_code == 204


def test_full_database_gives_507_and_keeps_its_rows(service):
    engine = service_of(service).database.engine
    large = urdf("large").replace(b"</robot>", b"<!--" + b"x" * 500_000 + b"--></robot>")  # many database pages

    def limit_pages(connection, *_):
        connection.execute("PRAGMA max_page_count = 1")

    event.listen(engine, "checkout", limit_pages)
    try:
        with closing(sqlite3.connect(service_of(service).settings.home / FILE, isolation_level=None)) as other:
            other.execute("CREATE TABLE ballast (x)")
        answers = [upload_robot(service, large) for _ in range(2)]
        error(answers[-1], 507, "storage_full")
        assert_reads_work(service)
    finally:
        event.remove(engine, "checkout", limit_pages)
    with engine.connect() as connection:
        connection.execute(text("PRAGMA max_page_count = 1000000"))
    engine.dispose()
    assert upload_robot(service, large).status_code == 201


def test_rejected_upload_leaves_nothing_on_a_full_disk(tmp_path):
    files = Files(tmp_path)
    (files.learning / "snap_1.draft").symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left") as found:
        files.write_snapshot("snap_1", b"0" * 10_000)
    assert type(translate_error(found.value)) is StorageFullError
    assert list(files.learning.iterdir()) == []


@pytest.mark.slow
def test_service_does_not_start_on_a_read_only_disk(tmp_path):
    with small_disk(tmp_path / "disk", 1 << 23) as mounted:
        if not mounted:
            pytest.skip("this process may not mount a disk")
        Database(tmp_path / "disk" / "home").close()
        subprocess.run(["mount", "-o", "remount,ro", str(tmp_path / "disk")], check=True)
        with pytest.raises(HomeError, match=r"service may write to: Read-only file system"):
            check_home(Settings(home=tmp_path / "disk" / "home"))


def test_service_does_not_start_on_a_later_database(tmp_path):
    database = Database(tmp_path)
    with database.transaction() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    database.close()
    with pytest.raises(HomeError, match=r"a later release of LIPServe has used it"):
        check_home(Settings(home=tmp_path))


def test_unreadable_texts_are_found(tmp_path):
    """One after the other, each text column of each table has a byte that is not UTF-8, or a number that JSON lacks."""
    database = Database(tmp_path)
    with closing(sqlite3.connect(tmp_path / FILE, isolation_level=None)) as other:
        other.execute("PRAGMA synchronous = OFF")
        other.execute("DROP TRIGGER audit_kept")
        for table in Base.metadata.sorted_tables:
            texts = [each for each in table.columns if isinstance(each.type, (String, JSON))]
            values = ", ".join("'[0]'" if each in texts else "0" for each in table.columns)
            other.execute(f"INSERT INTO {table} VALUES ({values})")
            for column in texts:
                for content in (b"[\xff]", b"[01]") if isinstance(column.type, JSON) else (b"[\xff]",):
                    other.execute(f'UPDATE {table} SET "{column.name}" = CAST(? AS TEXT)', (content,))
                    (fault,) = database.adapter.damage()
                    assert f"`{column.name}` of row" in fault
                    assert f"of the table {table} cannot be read" in fault
                other.execute(f"UPDATE {table} SET \"{column.name}\" = '[NaN, -Infinity]'")
        assert database.adapter.damage() == []
        other.execute("UPDATE versions SET manifest = CAST(x'ff' AS TEXT)")
    database.close()
    with pytest.raises(
        HomeError, match=r"`manifest` of row .* of the table versions cannot be read: .*restore a backup"
    ):
        check_home(Settings(home=tmp_path))


def test_service_does_not_start_while_the_database_stays_locked(tmp_path, monkeypatch):
    monkeypatch.setattr("service.storage.storage.WAIT_S", 0.1)
    Database(tmp_path).close()
    with locked(tmp_path / FILE), pytest.raises(HomeError, match="database is locked"):
        check_home(Settings(home=tmp_path))
    check_home(Settings(home=tmp_path))


def test_failed_start_is_explained(tmp_path):
    (tmp_path / FILE).write_bytes(b"no database" * 1000)
    log = tmp_path / "log"
    ended = Served(["serve", "--port", "0"], {**os.environ, "LIPSERVE_HOME": str(tmp_path)}, log)
    assert ended.wait(DEADLINE) == 1
    assert f"error: the database {tmp_path / FILE} cannot be used: file is not a database." in log.read_text()
    assert "Traceback" not in log.read_text()


@pytest.mark.own_files("the home of a service that others share holds next to nothing")
@pytest.mark.parametrize("gone", ["the home", "all but the database"])
def test_deleted_home_is_a_storage_failure(home, tmp_path, monkeypatch, gone):
    monkeypatch.setattr(Weighing, "expect", lambda self: None)  # a starting process would create its folders again
    with TestClient(create_app(Settings(home=home)), ADDRESS, raise_server_exceptions=False) as api:
        dataset = upload(api, stream())["id"]
        assert api.post("/v1/models/panda-sim/predict", json=ZERO).status_code == 200
        folders = [home] if gone == "the home" else [each for each in home.iterdir() if each.is_dir()]
        for folder in folders:
            shutil.rmtree(folder.rename(tmp_path / "deleted"))  # repeatedly, as the service still writes into it
        body = {name: getattr(stream(), name).tolist() for name in ("q", "tau")}
        answers = [
            api.get(f"/v1/datasets/{dataset}/preview"),
            api.get("/v1/models/panda-sim/export"),
            api.post("/v1/models/import", content=bytes(2048), headers={"content-type": "application/x-tar"}),
            post(api, npz(**body)),
        ]
        if gone == "the home":
            rows = {name: [[0.0] * 7] for name in (*ZERO, "tau")}
            observation = {"stream_id": "s", "sequence": 1, "t": [0.0], **rows}
            answers.append(api.post("/v1/models/panda-sim/observations", json=observation))
            answers.append(upload_robot(api))
            answers.append(api.get("/metrics"))
        for each in answers:
            error(each, 503, "storage_unavailable")
        assert str(home) not in "".join(each.text for each in answers)
        # a model in memory still predicts
        assert api.post("/v1/models/panda-sim/predict", json=ZERO).status_code == 200
