"""A backup holds what was acknowledged before it began, and nothing half; a home that is made of it goes on."""

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
from tests.service.archives.packing import TAR, exported, pack, unpack
from tests.service.data import QUICK, arrays, eventually, npz, queue, stream
from tests.service.faults.damage import flip
from tests.service.faults.house import SETTINGS, furnish
from tests.service.faults.ledger import ARM, Ledger, batch, listed
from tests.service.learning.pendulums import Arm
from tests.service.server import Server

pytestmark = pytest.mark.own_files("a home that shares a database is not backed up so")
ROUNDS = 3


@dataclass
class Load:
    """Clients that upload, teach, publish and train until they are told to stop.

    there, gone: data sets and imported versions that are acknowledged, and whose deletion is; taught: batches;
    rounds: how often each client has come round.
    """

    server: Server
    there: dict[str, dict] = field(default_factory=dict)
    gone: set[str] = field(default_factory=set)
    versions: set[int] = field(default_factory=set)
    deleted: set[int] = field(default_factory=set)
    taught: list[int] = field(default_factory=list)
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
        return [self.upload, self.teach, self.publish, self.train]

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
            self.there[name] = answer.json()
            if not keep:
                assert self.server.client.delete(f"/v1/datasets/{name}").status_code == 204
                self.gone.add(name)

    def teach(self) -> None:
        """Teach a batch."""
        sequence = len(self.taught)
        answer = self.server.client.post(f"/v1/models/{ARM}/observations", json=batch(sequence))
        assert answer.status_code == 200, answer.text
        self.taught.append(sequence)

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
        """Queue a job, and let it run on; a few in all."""
        number = self.rounds.get("train", 0)
        if number >= ROUNDS:
            self._over.wait(0.1)
            return
        queue(self.server.client, f"made-{number}", next(iter(self.there.values()))["id"], options=QUICK)

    def come_round(self) -> None:
        """Wait until every client has done all it does once more."""
        before = dict(self.rounds)
        of = [each.__name__ for each in self._clients()]
        eventually(lambda: self.failures or all(self.rounds.get(each, 0) > before.get(each, 0) for each in of))
        assert self.failures == []

    def end(self) -> None:
        """Let all clients end."""
        self._over.set()
        for thread in self._threads:
            thread.join()
        assert self.failures == []


def column(home, query):
    with closing(sqlite3.connect(home / "lipserve.sqlite3")) as database:
        return [value for (value,) in database.execute(query)]


def check_files(home):
    """Every row has its file, and every file its row."""
    for folder, query in (
        ("datasets", "SELECT id || '.safetensors' FROM datasets"),
        ("versions", "SELECT folder FROM versions"),
        ("learning", "SELECT id || '.safetensors' FROM snapshots"),
    ):
        assert sorted(path.name for path in (home / folder).glob("*")) == sorted(column(home, query))


@pytest.fixture
def busy(tmp_path):
    home = tmp_path / "busy"
    furnish(home)
    with Server(home, warm=True, **{f"LIPSERVE_{name}": value for name, value in SETTINGS.items()}) as server:
        load = Load(server)
        try:
            yield load
        finally:
            load._over.set()
            for thread in load._threads:
                thread.join()


@pytest.mark.parametrize(
    "rounds",
    [pytest.param(20, id="most files before"), pytest.param(0, id="all at the moment", marks=pytest.mark.slow)],
)
def test_what_was_acknowledged_before_a_backup_under_load_is_restored(busy, tmp_path, monkeypatch, rounds):
    monkeypatch.setattr(backups, "MAX_ROUNDS", rounds)
    for number in range(ROUNDS):
        busy.come_round()
        there, gone, taught = set(busy.there) - busy.gone, set(busy.gone), len(busy.taught)
        versions, deleted = busy.versions - busy.deleted, set(busy.deleted)
        made = backup(busy.server.home, tmp_path / f"{number}.tar")
        home = tmp_path / f"restored{number}"
        assert restore(home, tmp_path / f"{number}.tar") == made
        kept = set(column(home, "SELECT id FROM datasets"))
        # the client may have begun to delete what was there when it was asked last
        assert there - (busy.gone - gone) <= kept
        assert not gone & kept
        copies = set(column(home, "SELECT version FROM versions WHERE model = 'copy'"))
        assert versions - (busy.deleted - deleted) <= copies
        assert not deleted & copies
        sequences = column(home, f"SELECT sequence FROM events WHERE model = '{ARM}' ORDER BY sequence")
        assert sequences == list(range(len(sequences)))
        assert len(sequences) >= taught
        check_files(home)
        assert verify_home(Settings(home=home)).damages == []
    busy.end()
    with Server(home, warm=True, **{f"LIPSERVE_{name}": value for name, value in SETTINGS.items()}) as server:
        jobs = listed(server.client, "/v1/jobs")
        assert jobs
        ledger = Ledger(
            datasets={name: each for name, each in busy.there.items() if name in kept},
            batches=dict.fromkeys(sequences, "learnt"),
            imported={"copy": sorted(copies)},
            jobs={each["id"]: "succeeded" for each in jobs},
            models={each["model"] for each in jobs},
        )
        ledger.verify(server.client, home)


@pytest.fixture
def arm(home):
    made = Arm.open(home)
    made.batches(0, 1)
    made.snapshot()
    yield made
    made.database.close()


@pytest.fixture
def saved(arm, tmp_path):
    """A backup of a home with a model, two batches and a snapshot."""
    file = tmp_path / "saved.tar"
    backup(arm.settings.home, file)
    return file


def test_what_is_deleted_after_the_moment_is_copied_and_nothing_is_committed_at_it(arm, tmp_path, monkeypatch):
    home, at_once = arm.settings.home, []

    def moment():
        with closing(sqlite3.connect(home / "lipserve.sqlite3", timeout=0)) as other:
            with pytest.raises(sqlite3.OperationalError, match="locked"):
                other.execute("BEGIN IMMEDIATE")
            at_once.append(len(other.execute("SELECT id FROM snapshots").fetchall()))
        return "2026-01-01T00:00:00.000+00:00"

    def add(*arguments):
        if not added:  # the moment is over
            arm.batch(2)
            with arm.database.transaction() as session:
                session.execute(delete(SnapshotRow))
            shutil.rmtree(home / "learning")
            shutil.rmtree(home / "versions")
        added.append(arguments)
        write(*arguments)

    added, write = [], backups._add
    monkeypatch.setattr(backups, "MAX_ROUNDS", 0)
    monkeypatch.setattr(backups, "now", moment)
    monkeypatch.setattr(backups, "_add", add)
    made = backup(home, tmp_path / "b.tar")
    assert (made.snapshots, made.observations, at_once) == (1, 2, [1])
    restore(tmp_path / "back", tmp_path / "b.tar")
    check_files(tmp_path / "back")
    assert verify_home(Settings(home=tmp_path / "back")).damages == []


def test_what_is_deleted_after_it_was_copied_and_before_the_moment_is_left_out(arm, tmp_path, monkeypatch):
    gone, home = arm.publish("gone"), arm.settings.home
    folder = registry.find(arm.database, "gone", gone).folder
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


def test_commands_copy_a_home_and_bring_it_back(lipserve, arm, tmp_path, monkeypatch):
    monkeypatch.setenv("LIPSERVE_HOME", str(arm.settings.home))
    file = tmp_path / "b.tar"
    code, out, _ = lipserve("backup", file)
    assert code == 0
    assert "copied 0 data sets, 1 version, 1 snapshot and 2 batches as of 20" in out
    assert file.stat().st_mode & 0o777 == 0o600
    assert [path for path in tmp_path.iterdir() if path.name.startswith((".backup", "b.tar."))] == []
    code, _, err = lipserve("backup", file)
    assert code == 1
    assert "expected a new one" in err
    monkeypatch.setenv("LIPSERVE_HOME", str(tmp_path / "back"))
    code, out, _ = lipserve("restore", file, "--json")
    assert (code, json.loads(out)["observations"]) == (0, 2)
    assert lipserve("verify")[0] == 0
    code, _, err = lipserve("restore", file)
    assert code == 1
    assert "expected an empty folder: nothing is restored over what is there" in err


@pytest.mark.parametrize("command", ["backup", "restore"])
def test_a_home_that_shares_a_database_is_refused_with_what_to_do_instead(
    lipserve, home, tmp_path, monkeypatch, command
):
    monkeypatch.setenv("LIPSERVE_HOME", str(home))
    monkeypatch.setenv("LIPSERVE_DATABASE_URL", "postgresql://nobody@localhost/none")
    monkeypatch.setenv("LIPSERVE_FILES_URL", "s3://bucket/prefix")
    code, _, err = lipserve(command, tmp_path / "b.tar")
    assert code == 1
    assert "LIPSERVE_DATABASE_URL is set" in err
    assert "pg_dump" in err
    assert "versioning of the bucket" in err


def test_a_home_without_a_database_has_no_backup(home, tmp_path):
    with pytest.raises(FileNotFoundError, match="expected a folder with the database"):
        backup(home, tmp_path / "b.tar")
    assert not (tmp_path / "b.tar").exists()


def test_a_damaged_home_is_not_copied_as_if_it_were_whole(arm, tmp_path):
    next((arm.settings.home / "learning").glob("snap_*")).unlink()
    with pytest.raises(BackupError, match=r"learning/snap_\w+.safetensors is missing .* `lipserve verify`"):
        backup(arm.settings.home, tmp_path / "b.tar")
    assert not list(tmp_path.glob("b.tar*"))


def test_nothing_is_restored_below_a_service(saved, tmp_path):
    target = tmp_path / "used"
    with lock_home(target), pytest.raises(HomeError, match="another service uses"):
        restore(target, saved)


@pytest.mark.parametrize("member", ["versions/mv_arm_0/model.safetensors", "lipserve.sqlite3", "backup.json"])
@pytest.mark.parametrize("where", ["before", "within"])
def test_a_backup_that_is_cut_off_is_refused_and_leaves_nothing(saved, tmp_path, member, where):
    with tarfile.open(saved) as tar:
        info = tar.getmember(member)
    saved.write_bytes(saved.read_bytes()[: info.offset if where == "before" else info.offset_data + info.size // 2])
    check_refused(saved, tmp_path, "damaged|cut off|is no backup")


@pytest.mark.parametrize("name", ["versions/mv_arm_0/model.safetensors", "lipserve.sqlite3", "backup.json"])
def test_a_backup_with_another_byte_is_refused(saved, tmp_path, name):
    with tarfile.open(saved) as tar:
        member = tar.getmember(name)
    payload = bytearray(saved.read_bytes())
    payload[member.offset_data + member.size // 2] ^= 0x40
    saved.write_bytes(payload)
    check_refused(saved, tmp_path, "damaged|is no backup|is not what")


def test_a_member_that_is_left_out_is_missed(saved, tmp_path):
    files = unpack(saved.read_bytes())
    del files[next(name for name in files if name.startswith("learning/"))]
    saved.write_bytes(pack(files, tarfile.GNU_FORMAT))
    check_refused(saved, tmp_path, r"learning/snap_\w+.safetensors is not what backup.json says")


@pytest.mark.parametrize(
    "name", ["../outside", "/etc/outside", "versions/mv_1/../../../x", "datasets/x", "versions/mv_1/.x", "uploads/ds_1"]
)
def test_files_land_in_their_places_only(tmp_path, name):
    file = tmp_path / "evil.tar"
    file.write_bytes(pack({name: b"x"}, tarfile.GNU_FORMAT))
    check_refused(file, tmp_path, "which no backup does")


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.DIRTYPE])
def test_only_plain_files_are_taken(tmp_path, kind):
    info = tarfile.TarInfo("lipserve.sqlite3")
    info.type, info.linkname = kind, "/etc/passwd"
    raw = io.BytesIO()
    with tarfile.open(fileobj=raw, mode="w") as tar:
        tar.addfile(info)
    file = tmp_path / "evil.tar"
    file.write_bytes(raw.getvalue())
    check_refused(file, tmp_path, "which no backup does")


def test_a_backup_of_a_later_release_is_said_to_be_one(saved, tmp_path):
    files = unpack(saved.read_bytes())
    files["backup.json"] = files["backup.json"].replace(b'"format_version": 1', b'"format_version": 2')
    saved.write_bytes(pack(files, tarfile.GNU_FORMAT))
    check_refused(saved, tmp_path, "format_version 2, expected 1: a later release")


def test_a_damaged_home_is_copied_bit_for_bit_where_its_files_are_there(arm, tmp_path):
    """What a disk has spoilt is for `verify` to find, before and after."""
    flip(arm.settings.home / "versions/mv_arm_0/model.safetensors")
    backup(arm.settings.home, tmp_path / "b.tar")
    restore(tmp_path / "back", tmp_path / "b.tar")
    assert [each.kind for each in verify_home(Settings(home=tmp_path / "back")).damages] == ["version"]


def check_refused(file, tmp_path, message):
    target = tmp_path / "refused"
    with pytest.raises(BackupError, match=message):
        restore(target, file)
    assert [path.name for path in target.iterdir() if path.name != ".lock"] == []
