"""What single steps leave on a disk: new homes with what is first stored there, copies of them, commits not synced."""

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
from tests.service.power import disk
from tests.service.power.disk import MODELS, Disk
from tests.service.power.recording import Recording, needs_compiler

pytestmark = [needs_compiler, pytest.mark.own_files("what a disk of its own keeps")]
CHOICES = 12
"""Of what is left, by either rule; each kind of thing is kept or lost in several of them."""
CONTENT = b"learnt" * 2000
BEGIN = """
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
KILLED = "os._exit(0)\n"


def run(recording: Recording, code: str) -> None:
    """Run a program that is recorded, with the home as its argument; it ends as one that is killed."""
    environment = {**os.environ, **recording.environment}
    subprocess.run([sys.executable, "-c", BEGIN + code + KILLED, str(recording.home)], env=environment, check=True)


def left(recording: Recording, folder: Path) -> Iterator[Path]:
    """What power cuts at the end may leave of the recorded folder."""
    for model, choice in product(MODELS, range(CHOICES)):
        made = Disk(recording, model, Random(choice))
        for record in recording.records():
            made.do(record)
        disk.write(made.cut(Random(choice)), folder / "left")
        yield folder / "left"
        shutil.rmtree(folder / "left")


def stored(home: Path) -> dict[str, bytes]:
    """What rows name, and the files have."""
    database = Database(home)
    with database.session() as session:
        ids = list(session.scalars(select(SnapshotRow.id)))
    database.close()
    return {each: (home / "learning" / f"{each}.safetensors").read_bytes() for each in ids}


COPIES = """
store("snap_1")
from service.storage.backup import backup, restore
from service.storage.files.objects import FolderStore
root = home.parents[2]
(root / "file").write_bytes(b"shared")
FolderStore(root).put(root / "file", "store/versions/mv_1/file")
backup(home, root / "backup")
restore(home.parents[1] / "again" / "home", root / "backup")
"""


def test_what_is_first_stored_in_a_new_home_is_there_and_so_are_copies_of_it(tmp_path):
    """Each folder on the way has its name in one above it."""
    recording = Recording(tmp_path / "recorded")
    recording.home = recording.root / "disk" / "of" / "robots"
    run(recording, COPIES)
    for root in left(recording, tmp_path):
        assert stored(root / "disk" / "of" / "robots") == {"snap_1": CONTENT}
        assert stored(root / "disk" / "again" / "home") == {"snap_1": CONTENT}
        restore(root / "once more", root / "backup")
        assert stored(root / "once more") == {"snap_1": CONTENT}
        assert (root / "store" / "versions" / "mv_1" / "file").read_bytes() == b"shared"


REFUSED = """
try:
    store("snap_2")
except SQLAlchemyError as error:
    assert is_undecided(error)
else:
    raise AssertionError("what could not be synced was taken")
"""


@pytest.mark.slow
def test_a_commit_that_was_not_synced_may_be_there_with_its_file_and_nothing_stands_on_it(tmp_path):
    """The next start finds it in SQLite's log, from memory, as the service was only killed; it is not on the disk."""
    recording = Recording(tmp_path / "recorded")
    run(recording, 'store("snap_1")\n')
    recording.fail("*-wal")
    run(recording, REFUSED)
    assert recording.failed() == 1
    found = [stored(root / "home") for root in left(recording, tmp_path)]
    assert {len(each) for each in found} == {1, 2}
    assert all(content == CONTENT for each in found for content in each.values())
    run(recording, 'database.adapter.settle()\nstore("snap_3")\n')
    for root in left(recording, tmp_path):
        assert stored(root / "home").keys() >= {"snap_1", "snap_3"}
