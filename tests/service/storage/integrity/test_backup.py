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
from tests.service.data import QUICK, arrays, eventually, npz, queue, stream
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
        self._threads = [threading.Thread(target=self._repeat, args=(each,)) for each in self._clients()]
        for thread in self._threads:
            thread.start()

    def _clients(self) -> list[Callable[[], None]]:
        return [self.upload, self.send_batch, self.publish, self.train]

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
            body = npz(**arrays(stream(samples=40, seed=next(self._names) % 50)))
            answer = self.server.client.post(
                "/v1/datasets", content=body, headers={"content-type": "application/x-npz"}
            )
            assert answer.status_code == 201, answer.text
            name = answer.json()["id"]
            self.stored[name] = answer.json()
            if not keep:
                assert self.server.client.delete(f"/v1/datasets/{name}").status_code == 204
                self.removed.add(name)

    def send_batch(self) -> None:
        """Send an observation batch."""
        sequence = len(self.sent)
        answer = self.server.client.post(f"/v1/models/{ARM}/observations", json=batch(sequence))
        assert answer.status_code == 200, answer.text
        self.sent.append(sequence)

    def publish(self) -> None:
        """Import two versions, and delete the second."""
        for keep in (True, False):
            answer = self.server.client.post("/v1/models/import?name=copy", content=self._archive, headers=TAR)
            assert answer.status_code == 201, answer.text
            version = answer.json()["version"]
            self.versions.add(version)
            if not keep:
                assert self.server.client.delete(f"/v1/models/copy/versions/{version}").status_code == 204
                self.deleted.add(version)

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
        of = [each.__name__ for each in self._clients()]
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


def check_files(home):
    """Check that every row has its file, and every file its row."""
    for folder, query in (
        ("datasets", "SELECT id || '.safetensors' FROM datasets"),
        ("versions", "SELECT folder FROM versions"),
        ("learning", "SELECT id || '.safetensors' FROM snapshots"),
    ):
        assert sorted(path.name for path in (home / folder).glob("*")) == sorted(column(home, query))


@pytest.fixture
def busy_server(tmp_path):
    home = tmp_path / "busy"
    populate_home(home)
    with Server(home, warm=True, **{f"LIPSERVE_{name}": value for name, value in SETTINGS.items()}) as server:
        load = BackgroundClients(server)
        try:
            yield load
        finally:
            load._over.set()
            for thread in load._threads:
                thread.join()


@pytest.mark.slow
@pytest.mark.parametrize(
    "rounds",
    [pytest.param(20, id="most files before"), pytest.param(0, id="all at the moment", marks=pytest.mark.slow)],
)
def test_backup_under_load_contains_all_acknowledged_changes(busy_server, tmp_path, monkeypatch, rounds):
    monkeypatch.setattr(backups, "MAX_ROUNDS", rounds)
    for number in range(ROUNDS):
        busy_server.wait_for_round()
        stored, removed, sent = (
            set(busy_server.stored) - busy_server.removed,
            set(busy_server.removed),
            len(busy_server.sent),
        )
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
        check_files(home)
        assert verify_home(Settings(home=home)).damages == []
    busy_server.end()
    with Server(home, warm=True, **{f"LIPSERVE_{name}": value for name, value in SETTINGS.items()}) as server:
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


@pytest.fixture
def arm(home):
    made = Arm.open(home)
    made.log_batches(0, 1)
    made.store_snapshot()
    yield made
    made.database.close()


@pytest.fixture
def saved(arm, tmp_path):
    """A backup of a home with a model, two batches and a snapshot."""
    file = tmp_path / "saved.tar"
    backup(arm.settings.home, file)
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
    check_files(tmp_path / "back")
    assert verify_home(Settings(home=tmp_path / "back")).damages == []


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
    check_files(tmp_path / "back")


def test_commands_back_up_and_restore_a_home(lipserve, arm, tmp_path, monkeypatch):
    monkeypatch.setenv("LIPSERVE_HOME", str(arm.settings.home))
    file = tmp_path / "b.tar"
    code, out, _ = lipserve("backup", file)
    assert code == 0
    assert "copied 0 data sets, 1 version, 1 snapshot and 2 batches as of 20" in out
    assert file.stat().st_mode & 0o777 == 0o600
    assert [path for path in tmp_path.iterdir() if path.name.startswith((".backup", "b.tar."))] == []
    code, _, err = lipserve("backup", file)
    assert code == 1
    assert "expected a new file" in err
    monkeypatch.setenv("LIPSERVE_HOME", str(tmp_path / "back"))
    code, out, _ = lipserve("restore", file, "--json")
    assert (code, json.loads(out)["observations"]) == (0, 2)
    assert lipserve("verify")[0] == 0
    code, _, err = lipserve("restore", file)
    assert code == 1
    assert "expected an empty folder, as nothing is overwritten" in err


@pytest.mark.parametrize("command", ["backup", "restore"])
def test_home_with_a_shared_database_is_rejected_with_advice(lipserve, home, tmp_path, monkeypatch, command):
    monkeypatch.setenv("LIPSERVE_HOME", str(home))
    monkeypatch.setenv("LIPSERVE_DATABASE_URL", "postgresql://nobody@localhost/none")
    monkeypatch.setenv("LIPSERVE_FILES_URL", "s3://bucket/prefix")
    code, _, err = lipserve(command, tmp_path / "b.tar")
    assert code == 1
    assert "LIPSERVE_DATABASE_URL is set" in err
    assert "pg_dump" in err
    assert "bucket versioning" in err


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


@pytest.mark.parametrize("member", ["versions/mv_arm_0/model.safetensors", "lipserve.sqlite3", "backup.json"])
@pytest.mark.parametrize("where", ["before", "within"])
def test_truncated_backup_is_rejected_and_leaves_nothing(saved, tmp_path, member, where):
    with tarfile.open(saved) as tar:
        info = tar.getmember(member)
    saved.write_bytes(saved.read_bytes()[: info.offset if where == "before" else info.offset_data + info.size // 2])
    assert_rejected(saved, tmp_path, "damaged|incomplete|is not a backup")


@pytest.mark.parametrize("name", ["versions/mv_arm_0/model.safetensors", "lipserve.sqlite3", "backup.json"])
def test_changed_backup_is_rejected(saved, tmp_path, name):
    with tarfile.open(saved) as tar:
        member = tar.getmember(name)
    payload = bytearray(saved.read_bytes())
    payload[member.offset_data + member.size // 2] ^= 0x40
    saved.write_bytes(payload)
    assert_rejected(saved, tmp_path, "damaged|is not a backup|does not match")


def test_missing_member_is_reported(saved, tmp_path):
    files = unpack(saved.read_bytes())
    del files[next(name for name in files if name.startswith("learning/"))]
    saved.write_bytes(pack(files, tarfile.GNU_FORMAT))
    assert_rejected(saved, tmp_path, r"learning/snap_\w+.safetensors does not match backup.json")


@pytest.mark.parametrize(
    "name", ["../outside", "/etc/outside", "versions/mv_1/../../../x", "datasets/x", "versions/mv_1/.x", "uploads/ds_1"]
)
def test_files_are_restored_in_their_folders_only(tmp_path, name):
    file = tmp_path / "evil.tar"
    file.write_bytes(pack({name: b"x"}, tarfile.GNU_FORMAT))
    assert_rejected(file, tmp_path, "unexpected or repeated entry")


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.DIRTYPE])
def test_only_plain_files_are_restored(tmp_path, kind):
    info = tarfile.TarInfo("lipserve.sqlite3")
    info.type, info.linkname = kind, "/etc/passwd"
    raw = io.BytesIO()
    with tarfile.open(fileobj=raw, mode="w") as tar:
        tar.addfile(info)
    file = tmp_path / "evil.tar"
    file.write_bytes(raw.getvalue())
    assert_rejected(file, tmp_path, "unexpected or repeated entry")


def test_backup_of_a_later_release_is_reported(saved, tmp_path):
    files = unpack(saved.read_bytes())
    files["backup.json"] = files["backup.json"].replace(b'"format_version": 1', b'"format_version": 2')
    saved.write_bytes(pack(files, tarfile.GNU_FORMAT))
    assert_rejected(saved, tmp_path, "format_version 2, expected 1: it was made by a later release")


def test_home_with_changed_files_is_copied_bit_for_bit(arm, tmp_path):
    """`verify` finds damaged contents, in the home and in the restored one."""
    flip(arm.settings.home / "versions/mv_arm_0/model.safetensors")
    backup(arm.settings.home, tmp_path / "b.tar")
    restore(tmp_path / "back", tmp_path / "b.tar")
    assert [each.kind for each in verify_home(Settings(home=tmp_path / "back")).damages] == ["version"]


def assert_rejected(file, tmp_path, message):
    target = tmp_path / "refused"
    with pytest.raises(BackupError, match=message):
        restore(target, file)
    assert [path.name for path in target.iterdir() if path.name != ".lock"] == []
