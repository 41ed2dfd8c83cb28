"""A backup contains all acknowledged changes before its start, each completely; a service runs on the restored home."""

import io
import json
import shutil
import sqlite3
import tarfile
import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from itertools import count

import pytest
from sqlalchemy import delete

from service.cli.verify import verify_home
from service.foundation.settings import Settings
from service.models import registry
from service.storage import backup as backups
from service.storage.backup import BackupError, backup, restore
from service.storage.database import LearnerRow, SnapshotRow, VersionRow
from service.storage.storage import HomeError, lock_home
from tests.service.data import QUICK, eventually, queue, stream, upload
from tests.service.learning.pendulums import Arm
from tests.service.models.archives.packing import TAR, exported, pack, unpack
from tests.service.server import Server
from tests.system.faults.damage import flip
from tests.system.faults.harness import SETTINGS, populate_home
from tests.system.faults.ledger import ARM, Ledger, batch, list_items

pytestmark = pytest.mark.own_files("a home that shares a database is not backed up so")
ROUNDS = 3


@dataclass
class BackgroundClients:
    """Clients that upload, send batches, import and train until the test ends them.

    stored, removed: data sets whose upload, or deletion, is acknowledged; versions, deleted: the same of imported
    versions; sent: sequences of batches; rounds: number of completed calls of each client.
    """

    server: Server
    stored: dict[str, dict] = field(default_factory=dict)
    removed: set[str] = field(default_factory=set)
    versions: set[int] = field(default_factory=set)
    deleted: set[int] = field(default_factory=set)
    sent: list[int] = field(default_factory=list)
    rounds: dict[str, int] = field(default_factory=dict)
    failures: list[BaseException] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._over = threading.Event()
        self._archive = exported(self.server.client, ARM, version=2, learnt=False)
        self._names = count()
        self.upload()
        self._clients = [self.upload, self.send_batch, self.publish, self.train]
        self._threads = [threading.Thread(target=self._repeat, args=(each,)) for each in self._clients]
        for thread in self._threads:
            thread.start()

    def _repeat(self, act: Callable[[], None]) -> None:
        while not self._over.is_set():
            try:
                act()
            except BaseException as error:
                self.failures.append(error)
                return
            self.rounds[act.__name__] = self.rounds.get(act.__name__, 0) + 1

    def upload(self) -> None:
        """Upload two data sets, and delete one of them."""
        for keep in (True, False):
            made = upload(self.server.client, stream(samples=40, seed=next(self._names) % 50))
            self.stored[made["id"]] = made
            if not keep:
                assert self.server.client.delete(f"/v1/datasets/{made['id']}").status_code == 204
                self.removed.add(made["id"])

    def send_batch(self) -> None:
        """Send an observation batch."""
        sequence = len(self.sent)
        answer = self.server.client.post(f"/v1/models/{ARM}/observations", json=batch(sequence))
        assert answer.status_code == 200, answer.text
        self.sent.append(sequence)

    def publish(self) -> None:
        """Import two versions, and delete the first, which has stopped serving."""
        made = []
        for _ in range(2):
            answer = self.server.client.post("/v1/models/import?name=copy", content=self._archive, headers=TAR)
            assert answer.status_code == 201, answer.text
            made.append(answer.json()["version"])
            self.versions.add(made[-1])
        assert self.server.client.delete(f"/v1/models/copy/versions/{made[0]}").status_code == 204
        self.deleted.add(made[0])

    def train(self) -> None:
        """Queue a job without waiting for it, up to a few times."""
        number = self.rounds.get("train", 0)
        if number >= ROUNDS:
            self._over.wait(0.1)
            return
        queue(self.server.client, f"made-{number}", next(iter(self.stored.values()))["id"], options=QUICK)

    def wait_for_round(self) -> None:
        """Wait until every client has completed another call."""
        before = dict(self.rounds)
        of = [each.__name__ for each in self._clients]
        eventually(lambda: self.failures or all(self.rounds.get(each, 0) > before.get(each, 0) for each in of))
        assert self.failures == []

    def end(self) -> None:
        """Stop all clients."""
        self._over.set()
        for thread in self._threads:
            thread.join()
        assert self.failures == []


def column(home, query):
    with closing(sqlite3.connect(home / "lipserve.sqlite3")) as database:
        return [value for (value,) in database.execute(query)]


def check_restored(home):
    """Check that every row has its file, every file its row, and that no file is damaged."""
    for folder, queries in (
        ("datasets", [f"SELECT id || '.{each}' FROM datasets" for each in ("safetensors", "recording")]),
        ("versions", ["SELECT folder FROM versions"]),
        ("learning", ["SELECT id || '.safetensors' FROM snapshots"]),
    ):
        named = [name for query in queries for name in column(home, query)]
        assert sorted(path.name for path in (home / folder).glob("*")) == sorted(named)
    assert verify_home(Settings(home=home)).damages == []


@pytest.fixture
def busy_server(tmp_path):
    home = tmp_path / "busy"
    populate_home(home)
    with start_server(home) as server:
        load = BackgroundClients(server)
        try:
            yield load
        finally:
            load.end()


def start_server(home):
    return Server(home, warm=True, **{f"LIPSERVE_{name}": value for name, value in SETTINGS.items()})


@pytest.mark.slow
@pytest.mark.parametrize("rounds", [20, 0], ids=["most files before", "all at the moment"])
def test_backup_under_load_contains_all_acknowledged_changes(busy_server, tmp_path, monkeypatch, rounds):
    monkeypatch.setattr(backups, "MAX_ROUNDS", rounds)
    for number in range(ROUNDS):
        busy_server.wait_for_round()
        removed, sent = set(busy_server.removed), len(busy_server.sent)
        stored = set(busy_server.stored) - busy_server.removed
        versions, deleted = busy_server.versions - busy_server.deleted, set(busy_server.deleted)
        made = backup(busy_server.server.home, tmp_path / f"{number}.tar")
        home = tmp_path / f"restored{number}"
        assert restore(home, tmp_path / f"{number}.tar") == made
        kept = set(column(home, "SELECT id FROM datasets"))
        # a deletion may be under way since the last check
        assert stored - (busy_server.removed - removed) <= kept
        assert not removed & kept
        copies = set(column(home, "SELECT version FROM versions WHERE model = 'copy'"))
        assert versions - (busy_server.deleted - deleted) <= copies
        assert not deleted & copies
        sequences = column(home, f"SELECT sequence FROM events WHERE model = '{ARM}' ORDER BY sequence")
        assert sequences == list(range(len(sequences)))
        assert len(sequences) >= sent
        check_restored(home)
    busy_server.end()
    with start_server(home) as server:
        jobs = list_items(server.client, "/v1/jobs")
        assert jobs
        ledger = Ledger(
            datasets={name: each for name, each in busy_server.stored.items() if name in kept},
            batches=dict.fromkeys(sequences, "learnt"),
            imported={"copy": sorted(copies)},
            jobs={each["id"]: "succeeded" for each in jobs},
            models={each["model"] for each in jobs},
        )
        ledger.verify(server.client, home)


def open_arm(home):
    """Open a home with a model, two batches and a snapshot."""
    made = Arm.open(home)
    made.log_batches(0, 1)
    made.store_snapshot()
    return made


@pytest.fixture
def arm(home):
    made = open_arm(home)
    yield made
    made.database.close()


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    """The content of a backup."""
    folder = tmp_path_factory.mktemp("saved")
    open_arm(folder / "home").database.close()
    backup(folder / "home", folder / "saved.tar")
    return (folder / "saved.tar").read_bytes()


@pytest.fixture
def saved(content, tmp_path):
    file = tmp_path / "saved.tar"
    file.write_bytes(content)
    return file


def test_backup_includes_later_deletions_and_no_later_commits(arm, tmp_path, monkeypatch):
    home, at_once = arm.settings.home, []

    def at_snapshot():
        with closing(sqlite3.connect(home / "lipserve.sqlite3", timeout=0)) as other:
            with pytest.raises(sqlite3.OperationalError, match="locked"):
                other.execute("BEGIN IMMEDIATE")
            at_once.append(len(other.execute("SELECT id FROM snapshots").fetchall()))
        return "2026-01-01T00:00:00.000+00:00"

    def add(*arguments):
        if not added:  # the snapshot is complete
            arm.log_batch(2)
            with arm.database.transaction() as session:
                session.execute(delete(SnapshotRow))
            shutil.rmtree(home / "learning")
            shutil.rmtree(home / "versions")
        added.append(arguments)
        write(*arguments)

    added, write = [], backups._add
    monkeypatch.setattr(backups, "MAX_ROUNDS", 0)
    monkeypatch.setattr(backups, "now", at_snapshot)
    monkeypatch.setattr(backups, "_add", add)
    made = backup(home, tmp_path / "b.tar")
    assert (made.snapshots, made.observations, at_once) == (1, 2, [1])
    restore(tmp_path / "back", tmp_path / "b.tar")
    check_restored(tmp_path / "back")


def test_file_deleted_before_the_snapshot_is_omitted(arm, tmp_path, monkeypatch):
    removed, home = arm.publish("gone"), arm.settings.home
    folder = registry.find(arm.database, "gone", removed).folder
    deleted, write = [], backups._add

    def add(tar, files, sums, size=None):
        write(tar, files, sums, size)
        if f"versions/{folder}/manifest.json" in files:
            with arm.database.transaction() as session:
                session.execute(delete(LearnerRow).where(LearnerRow.model == "gone"))
                session.execute(delete(VersionRow).where(VersionRow.model == "gone"))
            shutil.rmtree(home / "versions" / folder)
            deleted.append(folder)

    monkeypatch.setattr(backups, "_add", add)
    made = backup(home, tmp_path / "b.tar")
    assert (deleted, made.versions) == ([folder], 1)
    assert f"versions/{folder}/model.safetensors" in unpack((tmp_path / "b.tar").read_bytes())
    assert restore(tmp_path / "back", tmp_path / "b.tar") == made
    check_restored(tmp_path / "back")


def test_commands_back_up_and_restore_a_home(lipserve, arm, tmp_path, monkeypatch):
    monkeypatch.setenv("LIPSERVE_HOME", str(arm.settings.home))
    file = tmp_path / "b.tar"
    code, out, _ = lipserve("backup", file)
    assert (code, file.stat().st_mode & 0o777) == (0, 0o600)
    assert "copied 0 data sets, 1 version, 1 snapshot and 2 batches as of 20" in out
    assert [path for path in tmp_path.iterdir() if path.name.startswith((".backup", "b.tar."))] == []
    code, _, err = lipserve("backup", file)
    assert (code, "expected a new file" in err) == (1, True)
    monkeypatch.setenv("LIPSERVE_HOME", str(tmp_path / "back"))
    code, out, _ = lipserve("restore", file, "--json")
    assert (code, json.loads(out)["observations"]) == (0, 2)
    assert lipserve("verify")[0] == 0
    code, _, err = lipserve("restore", file)
    assert (code, "expected an empty folder, as nothing is overwritten" in err) == (1, True)


@pytest.mark.parametrize("command", ["backup", "restore"])
def test_home_with_a_shared_database_is_rejected_with_advice(lipserve, home, tmp_path, monkeypatch, command):
    monkeypatch.setenv("LIPSERVE_HOME", str(home))
    monkeypatch.setenv("LIPSERVE_DATABASE_URL", "postgresql://nobody@localhost/none")
    monkeypatch.setenv("LIPSERVE_FILES_URL", "s3://bucket/prefix")
    code, _, err = lipserve(command, tmp_path / "b.tar")
    assert code == 1
    assert [part for part in ("LIPSERVE_DATABASE_URL is set", "pg_dump", "bucket versioning") if part not in err] == []


def test_home_without_a_database_has_no_backup(home, tmp_path):
    with pytest.raises(FileNotFoundError, match="expected a folder with the database"):
        backup(home, tmp_path / "b.tar")
    assert not (tmp_path / "b.tar").exists()


def test_home_with_missing_files_is_not_backed_up(arm, tmp_path):
    next((arm.settings.home / "learning").glob("snap_*")).unlink()
    with pytest.raises(BackupError, match=r"learning/snap_\w+.safetensors is missing .* `lipserve verify`"):
        backup(arm.settings.home, tmp_path / "b.tar")
    assert not list(tmp_path.glob("b.tar*"))


def test_nothing_is_restored_below_a_running_service(saved, tmp_path):
    target = tmp_path / "used"
    with lock_home(target), pytest.raises(HomeError, match="another service uses"):
        restore(target, saved)


def truncated(name, end, file):
    with tarfile.open(file) as tar:
        info = tar.getmember(name)
    return file.read_bytes()[: info.offset_data + info.size // 2 if end == "within" else info.offset]


def changed(name, file):
    with tarfile.open(file) as tar:
        member = tar.getmember(name)
    content = bytearray(file.read_bytes())
    content[member.offset_data + member.size // 2] ^= 0x40
    return content


def repacked(change, file):
    files = unpack(file.read_bytes())
    change(files)
    return pack(files, tarfile.GNU_FORMAT)


def drop_snapshot(files):
    del files[next(name for name in files if name.startswith("learning/"))]


def raise_format_version(files):
    files["backup.json"] = files["backup.json"].replace(b'"format_version": 1', b'"format_version": 2')


def packed_member(kind, _):
    info = tarfile.TarInfo("lipserve.sqlite3")
    info.type, info.linkname = kind, "/etc/passwd"
    raw = io.BytesIO()
    with tarfile.open(fileobj=raw, mode="w") as tar:
        tar.addfile(info)
    return raw.getvalue()


def packed_file(name, _):
    return pack({name: b"x"}, tarfile.GNU_FORMAT)


MEMBERS = ("versions/mv_arm_0/model.safetensors", "lipserve.sqlite3", "backup.json")
OUTSIDE = ("../outside", "/etc/outside", "versions/mv_1/../../../x", "datasets/x", "versions/mv_1/.x", "uploads/ds_1")
KINDS = {"link": tarfile.SYMTYPE, "hard link": tarfile.LNKTYPE, "pipe": tarfile.FIFOTYPE, "folder": tarfile.DIRTYPE}
TORN, CHANGED = "damaged|incomplete|is not a backup", "damaged|is not a backup|does not match"
LOST, FOREIGN = r"learning/snap_\w+.safetensors does not match backup.json", "unexpected or repeated entry"
LATER = "format_version 2, expected 1: it was made by a later release"
ENDS = ("before", "within")
UNSOUND = {
    # a function that makes the content of an unsound backup of a sound one, and the message
    **{f"ends {end} {name}": (partial(truncated, name, end), TORN) for name in MEMBERS for end in ENDS},
    **{f"changed {name}": (partial(changed, name), CHANGED) for name in MEMBERS},
    "without a snapshot": (partial(repacked, drop_snapshot), LOST),
    "of a later release": (partial(repacked, raise_format_version), LATER),
    **{f"with {name}": (partial(packed_file, name), FOREIGN) for name in OUTSIDE},
    **{f"with a {name}": (partial(packed_member, kind), FOREIGN) for name, kind in KINDS.items()},
}


@pytest.mark.parametrize("name", UNSOUND)
def test_unsound_backup_is_rejected_and_leaves_nothing(saved, tmp_path, name):
    spoil, message = UNSOUND[name]
    saved.write_bytes(spoil(saved))
    target = tmp_path / "refused"
    with pytest.raises(BackupError, match=message):
        restore(target, saved)
    assert [path.name for path in target.iterdir() if path.name != ".lock"] == []


def test_home_with_changed_files_is_copied_bit_for_bit(arm, tmp_path):
    """`verify` finds damaged contents, in the home and in the restored one."""
    flip(arm.settings.home / "versions/mv_arm_0/model.safetensors")
    backup(arm.settings.home, tmp_path / "b.tar")
    restore(tmp_path / "back", tmp_path / "b.tar")
    assert [each.kind for each in verify_home(Settings(home=tmp_path / "back")).damages] == ["version"]
