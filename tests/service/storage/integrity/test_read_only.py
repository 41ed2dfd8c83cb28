"""`verify` reads a home that it cannot write to, and leaves nothing in it."""

import ctypes
import shutil
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import pytest

from service.cli.verify import verify_home
from service.foundation.settings import Settings
from service.storage.database.migrations import DatabaseVersionError
from tests.service.learning.pendulums import Arm
from tests.system.faults.damage import flip

pytestmark = pytest.mark.own_files("a shared database is no file of the home")
CAPABILITIES_VERSION = 0x20080522
LOG, INDEX = "lipserve.sqlite3-wal", "lipserve.sqlite3-shm"


def drop_capabilities():
    """Take root's right to write anywhere from this thread."""
    header, none = (ctypes.c_uint32 * 2)(CAPABILITIES_VERSION, 0), (ctypes.c_uint32 * 6)()
    if ctypes.CDLL(None, use_errno=True).capset(header, none) != 0:
        pytest.skip("this thread keeps the right to write everywhere")


def list_files(home):
    """Return content and time of each file and folder of a home."""
    return {
        path.relative_to(home): (path.stat().st_mtime_ns, path.read_bytes() if path.is_file() else b"")
        for path in [home, *home.rglob("*")]
    }


def verify_read_only(home):
    """Verify a home without permission to write; check that nothing in it changes."""
    for path in [home, *home.rglob("*")]:
        path.chmod(0o500 if path.is_dir() else 0o400)
    before = list_files(home)

    def verify():
        drop_capabilities()
        with pytest.raises(PermissionError):
            (home / "file").touch()
        return verify_home(Settings(home=home))

    try:
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(verify).result()
    finally:
        assert list_files(home) == before


@pytest.fixture
def left(home, tmp_path):
    """The home that a killed service with two batches and a snapshot leaves; the second batch is in SQLite's log."""
    arm = Arm.open(home)
    arm.log_batch(0)
    arm.store_snapshot()
    arm.database.adapter.settle()
    arm.log_batch(1)
    shutil.copytree(home, tmp_path / "left")
    arm.database.close()
    assert (tmp_path / "left" / LOG).stat().st_size > 0
    return tmp_path / "left"


def spoil_snapshot(home):
    flip(next((home / "learning").glob("snap_*")))


def close_database(home):
    with closing(sqlite3.connect(home / "lipserve.sqlite3")) as database:
        database.execute("SELECT count(*) FROM events").fetchone()
    assert not (home / LOG).exists()


STATES = {
    "closed": (close_database, 2, []),
    "killed": (lambda home: None, 2, []),
    "killed without index": (lambda home: (home / INDEX).unlink(), 2, []),
    "without the log": (lambda home: ((home / LOG).unlink(), (home / INDEX).unlink()), 1, []),
    "empty log": (lambda home: ((home / LOG).write_bytes(b""), (home / INDEX).unlink()), 1, []),
    "without uploads": (lambda home: (home / "uploads").rmdir(), 2, []),
    "damaged": (spoil_snapshot, 2, ["snapshot"]),
}


@pytest.mark.parametrize("state", STATES)
def test_read_only_home_is_verified_and_not_changed(left, state):
    change, batches, damaged = STATES[state]
    change(left)
    found = verify_read_only(left)
    assert [each.kind for each in found.damages] == damaged
    assert (found.read["versions"], found.read["snapshots"], found.read["observations"]) == (1, 1, batches)


OPEN = """
import sqlite3, sys
database = sqlite3.connect(sys.argv[1])
print(*database.execute("SELECT count(*) FROM events").fetchone(), flush=True)
sys.stdin.read()
"""
"""A process that has the database open, as a service has, until its input ends."""


def test_read_only_home_is_verified_while_another_process_has_it_open(left):
    command = [sys.executable, "-c", OPEN, str(left / "lipserve.sqlite3")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"2\n"
        found = verify_read_only(left)
    assert (found.damages, found.read["observations"]) == ([], 2)


def test_read_only_database_of_another_release_is_rejected_with_advice(left):
    with closing(sqlite3.connect(left / "lipserve.sqlite3")) as database:
        database.execute("UPDATE alembic_version SET version_num = '0011'")
        database.commit()
    with pytest.raises(DatabaseVersionError, match="read-only: run `lipserve verify` on a copy"):
        verify_read_only(left)
