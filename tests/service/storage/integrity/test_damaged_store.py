"""Damaged files are detected when they are read, and only their own contents are lost."""

import hashlib
import json
from functools import partial

import pytest
from sqlalchemy import delete, select, update

import lipcore
from lipcore import ModelFormatError
from lipcore.online import transfer
from lipcore.online.learner import OnlineModel
from service.cli.verify import verify_home
from service.foundation.errors import DamagedDataError
from service.foundation.settings import Settings
from service.journal import log
from service.models import registry
from service.storage.database import DatasetRow, EventRow, RobotRow, SnapshotRow, VersionRow
from service.storage.files import Files
from service.training.material import load_datasets
from tests.service.data import error, service_of, stream, upload
from tests.service.learning.pendulums import ARM, Arm
from tests.system.faults.damage import empty, flip, remove


@pytest.mark.parametrize("spoil", [flip, remove, empty])
def test_damaged_data_set_is_not_evaluated_or_trained_on(api, trained, spoil):
    dataset = upload(api, stream(samples=40, seed=31))
    service = service_of(api)
    spoil(service.files.datasets / f"{dataset['id']}.safetensors")
    answer = api.post(f"/v1/models/{trained.name}/evaluate", json={"dataset": dataset["id"]})
    assert dataset["id"] in error(answer, 500, "damaged_data")["message"]
    request = {"datasets": [dataset["id"]], "joint_types": ["revolute"] * 2}
    with pytest.raises(DamagedDataError, match="Upload it again"):
        load_datasets(service.database, service.files, request)
    assert api.get(f"/v1/datasets/{dataset['id']}").status_code == 200
    assert api.delete(f"/v1/datasets/{dataset['id']}").status_code == 204


@pytest.fixture
def arm(home):
    arm = Arm.open(home)
    yield arm
    arm.database.close()


@pytest.mark.parametrize("name", ["manifest.json", "model.safetensors"])
def test_exchanged_version_is_not_loaded(arm, name):
    """The manifest may be exchanged too, with correct hashes of other tensors."""
    row = registry.find(arm.database, ARM, 1)
    folder = arm.files.versions / row.folder
    if name == "manifest.json":
        manifest = json.loads((folder / name).read_text())
        manifest["calibration"]["function_std_factor"] = 50.0
        (folder / name).write_text(json.dumps(manifest))
        assert lipcore.load(folder).calibration.function_std_factor == 50.0
    else:
        flip(folder / name)
    with pytest.raises(ModelFormatError, match=f"{name} is damaged"):
        lipcore.load(folder, row.checksums)


@pytest.fixture
def store(arm):
    """A home with one file of each kind."""
    arm.log_batch(0)
    arm.store_snapshot()
    samples = stream(samples=40, seed=32)
    digest = arm.files.write_samples("ds_one", len(samples), samples.n_joints, partial(getattr, samples))
    with arm.database.transaction() as session:
        dataset = {"torque_convention": "gravity_included", "joint_names": list(samples.joint_names), "report": {}}
        session.add(DatasetRow(id="ds_one", name="one", created_at="", sha256=digest, rows=len(samples), **dataset))
        robot = {"sha256": hashlib.sha256(b"<robot/>").hexdigest(), "joints": []}
        session.add(RobotRow(id="rb_one", name="one", created_at="", urdf="<robot/>", **robot))
    return arm


def test_whole_store_is_reported_whole(store):
    found = verify_home(store.settings)
    assert found.damages == []
    assert found.read == {"datasets": 1, "robots": 1, "versions": 1, "snapshots": 1, "observations": 1, "models": 1}
    spoil_row(SnapshotRow, sha256=None)(store)  # a snapshot without a checksum is read
    assert verify_home(store.settings).damages == []


def spoil_row(table, **values):
    def spoil(store):
        with store.database.transaction() as session:
            session.execute(update(table).values(values))

    return spoil


DAMAGES = {
    "dataset": lambda store: flip(store.files.datasets / "ds_one.safetensors"),
    "dataset rows": spoil_row(DatasetRow, rows=7),
    "robot": spoil_row(RobotRow, urdf="<robot name='other'/>"),
    "version": lambda store: flip(next(store.files.versions.glob("*/model.safetensors"))),
    "version's manifest": spoil_row(VersionRow, manifest={}),
    "version's file": lambda store: next(store.files.versions.glob("*/manifest.json")).unlink(),
    "snapshot": lambda store: flip(next(store.files.learning.glob("snap_*"))),
    "snapshot lost": lambda store: next(store.files.learning.glob("snap_*")).unlink(),
    "observation": spoil_row(EventRow, payload=b"torn"),
    "observation rows": spoil_row(EventRow, rows=3),
}


def drop_event(store):
    """Lose a batch that the snapshot contains, as SQLite does not: the log has a gap."""
    store.log_batches(1, 2)
    with store.database.transaction() as session:
        session.execute(delete(EventRow).where(EventRow.number == 2))


def change_row(store):
    """Change one torque in the log by 0.1 N·m: the snapshot has learnt another one."""
    rows = log.rows_of(store.find(1))
    rows.tau[3, 0] += 0.1
    spoil_row(EventRow, payload=log.encode(rows))(store)


def exchange_snapshot(store):
    """Replace the snapshot by the state as trained, with a correct checksum."""
    payload = transfer.dump(OnlineModel.start(store.base))
    next(store.files.learning.glob("snap_*")).write_bytes(payload)
    spoil_row(SnapshotRow, sha256=hashlib.sha256(payload).hexdigest())(store)


DAMAGES |= {
    "snapshot of other rows": change_row,
    "snapshot exchanged": exchange_snapshot,
    "snapshot without an undo": spoil_row(EventRow, void=True),
    "model's log": drop_event,
}


@pytest.mark.parametrize("what", DAMAGES)
def test_each_damage_is_the_only_one_found(store, what):
    DAMAGES[what](store)
    (damage,) = verify_home(store.settings).damages
    assert damage.kind == what.split("'")[0].split()[0]
    assert damage.reason


def test_log_without_its_oldest_events_is_whole(arm):
    """Retention has deleted event 1, so event 2 cannot be unlearnt: both snapshots still contain it."""
    arm.log_batches(0, 1, 2)
    arm.store_snapshot()
    arm.log_batches(3, 4)
    arm.store_snapshot()
    with arm.database.transaction() as session:
        session.execute(delete(EventRow).where(EventRow.number == 1))
    arm.unlearn(2)
    found = verify_home(arm.settings)
    assert (found.damages, found.read["snapshots"]) == ([], 2)
    with arm.database.transaction() as session:  # the later snapshot has learnt another batch
        other = log.encode(log.rows_of(arm.find(4)))
        session.execute(update(EventRow).where(EventRow.number == 5).values(payload=other))
    assert [each.kind for each in verify_home(arm.settings).damages] == ["snapshot"]


def test_command_lists_damage_and_exits_with_1(store, lipserve, monkeypatch):
    monkeypatch.setenv("LIPSERVE_HOME", str(store.settings.home))
    code, out, _ = lipserve("verify", "--json")
    assert (code, json.loads(out)["damaged"]) == (0, [])
    DAMAGES["dataset"](store)
    code, out, _ = lipserve("verify", "--json")
    assert (code, json.loads(out)["damaged"][0]["name"]) == (1, "ds_one")


def test_home_without_a_database_is_rejected(tmp_path):
    with pytest.raises(FileNotFoundError, match="expected a folder with the database"):
        verify_home(Settings(home=tmp_path / "none"))
    assert not (tmp_path / "none").exists()


def test_file_deleted_during_the_check_is_not_damaged(store, monkeypatch):
    def read(self, dataset, *_):
        with store.database.transaction() as session:
            session.delete(session.scalar(select(DatasetRow)))
        raise DamagedDataError("its file is gone")

    monkeypatch.setattr(Files, "read_samples", read)
    assert verify_home(store.settings).damages == []
