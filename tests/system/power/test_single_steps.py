"""Power cuts after single steps: first writes to a new home, copies of it, and commits that were not synced."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from random import Random

import pytest
from sqlalchemy import select

from service.storage.backup import restore
from service.storage.database import Database, SnapshotRow
from tests.system.power import disk
from tests.system.power.disk import MODELS, Disk
from tests.system.power.recording import Recording, needs_compiler

pytestmark = [needs_compiler, pytest.mark.own_files("what a disk of its own keeps")]
CHOICES = 12
"""Simulated outcomes per file system rule."""
CONTENT = b"learnt" * 2000
PREAMBLE = """
import os, sys
from pathlib import Path
from sqlalchemy.exc import SQLAlchemyError
from service.storage.database import Database, SnapshotRow, now
from service.storage.files import Files
from service.storage.errors import is_undecided
home = Path(sys.argv[1])
database = Database(home)
files = Files(home)

def store(name):
    digest = files.write_snapshot(name, b"learnt" * 2000)
    with database.transaction() as session:
        session.add(SnapshotRow(id=name, model="m", version=1, number=1, created_at=now(), sha256=digest))
"""
EXIT_WITHOUT_CLEANUP = "os._exit(0)\n"


def run(recording: Recording, code: str) -> None:
    """Run recorded code with the home as its argument; it exits without cleanup."""
    environment = {**os.environ, **recording.environment}
    subprocess.run(
        [sys.executable, "-c", PREAMBLE + code + EXIT_WITHOUT_CLEANUP, str(recording.home)], env=environment, check=True
    )


def folders_after_power_cut(recording: Recording, folder: Path) -> Iterator[Path]:
    """Yield the recorded folder as power cuts at the end may leave it."""
    for model, choice in product(MODELS, range(CHOICES)):
        simulated_disk = Disk(recording, model, Random(choice))
        for record in recording.records():
            simulated_disk.apply(record)
        disk.write(simulated_disk.cut(Random(choice)), folder / "left")
        yield folder / "left"
        shutil.rmtree(folder / "left")


def read_snapshots(home: Path) -> dict[str, bytes]:
    """Return the content of the snapshots that rows name."""
    database = Database(home)
    with database.session() as session:
        ids = list(session.scalars(select(SnapshotRow.id)))
    database.close()
    return {each: (home / "learning" / f"{each}.safetensors").read_bytes() for each in ids}


COPY_CODE = """
store("snap_1")
from service.storage.backup import backup, restore
from service.storage.files.objects import FolderStore
root = home.parents[2]
(root / "file").write_bytes(b"shared")
FolderStore(root).put(root / "file", "store/versions/mv_1/file")
backup(home, root / "backup")
restore(home.parents[1] / "again" / "home", root / "backup")
"""


def test_first_snapshot_and_its_copies_survive_power_cut(tmp_path):
    """The names of all new folders must be synced in their parents."""
    recording = Recording(tmp_path / "recorded")
    recording.home = recording.root / "disk" / "of" / "robots"
    run(recording, COPY_CODE)
    for root in folders_after_power_cut(recording, tmp_path):
        assert read_snapshots(root / "disk" / "of" / "robots") == {"snap_1": CONTENT}
        assert read_snapshots(root / "disk" / "again" / "home") == {"snap_1": CONTENT}
        restore(root / "once more", root / "backup")
        assert read_snapshots(root / "once more") == {"snap_1": CONTENT}
        assert (root / "store" / "versions" / "mv_1" / "file").read_bytes() == b"shared"


REJECTED_COMMIT_CODE = """
try:
    store("snap_2")
except SQLAlchemyError as error:
    assert is_undecided(error)
else:
    raise AssertionError("what could not be synced was taken")
"""


def test_later_commits_do_not_depend_on_unsynced_one(tmp_path):
    """The next start reads the commit from SQLite's log in memory, because only the process died; the disk lacks it."""
    recording = Recording(tmp_path / "recorded")
    run(recording, 'store("snap_1")\n')
    recording.fail_syncs("*-wal")
    run(recording, REJECTED_COMMIT_CODE)
    assert recording.count_failed_syncs() == 1
    found = [read_snapshots(root / "home") for root in folders_after_power_cut(recording, tmp_path)]
    assert {len(each) for each in found} == {1, 2}
    assert all(content == CONTENT for each in found for content in each.values())
    run(recording, 'database.adapter.settle()\nstore("snap_3")\n')
    for root in folders_after_power_cut(recording, tmp_path):
        assert read_snapshots(root / "home").keys() >= {"snap_1", "snap_3"}
