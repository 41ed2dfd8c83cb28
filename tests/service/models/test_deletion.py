"""Deletion of versions and models: used ones stay, others are removed completely, and no number is reused."""

import threading
from types import SimpleNamespace

import pytest
from sqlalchemy import select, update

from lipcore.online.batch import Placement
from lipserve.states import CANCELLED, RUNNING
from service.contract.observations import LearningOptions
from service.foundation.errors import ConflictError, NotFoundError, UnreadableVersionError
from service.foundation.settings import Settings
from service.journal import snapshots
from service.learning.ingest.append import Arrival
from service.learning.learner.learnt import LearntVersions
from service.models import registry, shipped
from service.models.loaded import LoadedModels
from service.storage import database as tables
from service.storage.database import Database, now
from service.storage.files import Files
from tests.service.data import error, service_of
from tests.service.learning.batches import make_batch
from tests.service.models.versions import QUERY, predict, publish
from tests.service.training.conftest import new_row


@pytest.fixture
def service(api):
    return service_of(api)


def delete(api, path):
    return api.delete(f"/v1/models/{path}")


def error_message(api, path):
    return error(delete(api, path), 409, "conflict")["message"]


def folder(service, model, version):
    return service.files.versions / registry.find(service.database, model, version).folder


def add_job(service, model, state, **request):
    """Add a job that this service runs, as otherwise it would be taken over from a dead service; return its id."""
    fields = {"state": state, "heartbeat_at": now(), "owner": service.jobs.replicas.id}
    row = new_row(model[-30:], model=model, request={"estimator": "lip-chain", "datasets": []} | request, **fields)
    with service.database.transaction() as session:
        session.add(row)
        return row.id


def store_snapshot(service, model, version, number=1):
    return snapshots.save(service.database, service.files, model, version, number, number, b"state", most=5)


def observe(api, model, sequence=1):
    batch = {name: [values] for name, values in QUERY.items()} | {"tau": [[0.1, 0.2]], "t": [float(sequence)]}
    body = {"stream_id": "arm", "sequence": sequence, **batch}
    return api.post(f"/v1/models/{model}/observations", json=body)


@pytest.mark.own_files("looks for the files below the home")
def test_version_is_deleted_with_its_files_and_number(api, arm, service):
    place = folder(service, arm, 2)
    kept, gone = store_snapshot(service, arm, 1), store_snapshot(service, arm, 2)
    assert predict(api, arm, version=2).status_code == 200
    assert delete(api, f"{arm}/versions/2").status_code == 204
    assert not place.exists()
    assert [path.stem for path in service.files.learning.glob("snap_*") if path.stem in (kept, gone)] == [kept]
    error(predict(api, arm, version=2), 404, "not_found")
    error(delete(api, f"{arm}/versions/2"), 404, "not_found")
    assert [each["version"] for each in api.get(f"/v1/models/{arm}").json()["versions"]] == [1, 3]
    with service.database.session() as session:
        assert session.get(tables.LearnerRow, (arm, 2)) is None
        assert session.scalars(select(tables.SnapshotRow.version).where(tables.SnapshotRow.model == arm)).all() == [1]


def test_used_version_stays(api, arm, service):
    """The third version serves, the first has aliases, and a job retrains the second."""
    name = add_job(service, arm, RUNNING, refresh={"version": 2, "through": 0, "trigger": "asked"})
    for alias in ("production", "canary"):
        api.put(f"/v1/models/{arm}/aliases/{alias}", json={"version": 1})
    for path, reason in (
        (f"{arm}/versions/3", f"version 3 of model '{arm}' is the serving version"),
        (f"{arm}/versions/1", "has the alias 'canary', 'production'"),
        (f"{arm}/versions/2", f"{name} refreshes version 2"),
        (arm, f"{name} of model '{arm}' is running"),
    ):
        assert reason in error_message(api, path)
        assert predict(api, arm).json()["version"] == 3

    api.put(f"/v1/models/{arm}/aliases/serving", json={"version": 2})
    assert delete(api, f"{arm}/versions/3").status_code == 204
    assert publish(api, arm) == 4  # the newest number is not reused
    delete(api, f"{arm}/aliases/canary")
    api.put(f"/v1/models/{arm}/aliases/production", json={"version": 2})
    assert delete(api, f"{arm}/versions/1").status_code == 204
    delete(api, f"{arm}/aliases/production")
    with service.database.transaction() as session:
        session.execute(update(tables.JobRow).where(tables.JobRow.id == name).values(state=CANCELLED))
    assert delete(api, f"{arm}/versions/2").status_code == 204
    assert delete(api, arm).status_code == 204


def test_only_the_history_of_a_deleted_model_is_left(api, arm, service):
    """The test checks every table that names a model, so that it includes tables added later."""
    places = [folder(service, arm, version) for version in (1, 2, 3)]
    assert observe(api, arm).status_code == 200
    api.put(f"/v1/models/{arm}/learning", json={"auto_refresh": False})
    api.put(f"/v1/models/{arm}/aliases/production", json={"version": 1})
    name, kept = add_job(service, arm, CANCELLED), store_snapshot(service, arm, 1)
    with service.database.transaction() as session:
        session.add(tables.AlarmRow(model=arm, kind="change", at=now(), message="", evidence={}))
    every = {mapper.class_ for mapper in tables.Base.registry.mappers if "model" in mapper.columns}
    assert {tables.JobRow, tables.VersionRow} < every

    def tables_in_use(session):
        return {table for table in every if session.scalars(select(table).where(table.model == arm)).first()}

    with service.database.session() as session:
        assert tables_in_use(session) == every
    assert delete(api, arm).status_code == 204
    with service.database.session() as session:
        assert tables_in_use(session) == {tables.JobRow, tables.AuditRow}
        assert session.scalar(select(tables.ModelRow).where(tables.ModelRow.name == arm)) is None
        assert session.get(tables.DeletedModelRow, arm).last_version == 3
    assert not any(place.exists() for place in places)
    assert not list(service.files.learning.glob(f"{kept}*"))
    assert arm not in service.learners.monitors()
    assert api.get(f"/v1/jobs/{name}").json()["model"] == arm
    for answer in (
        *(predict(api, arm, **chosen) for chosen in ({}, {"alias": "production"}, {"version": 1})),
        api.get(f"/v1/models/{arm}"),
        observe(api, arm, 2),
        delete(api, arm),
    ):
        error(answer, 404, "not_found")
    assert arm not in [each["name"] for each in api.get("/v1/models", params={"limit": 100}).json()["items"]]


def test_new_model_of_the_same_name_continues_the_numbers(api, arm):
    observe(api, arm)
    assert delete(api, arm).status_code == 204
    assert publish(api, arm) == 4
    answer = predict(api, arm).json()
    assert (answer["version"], answer["revision"]) == (4, 0)
    assert api.get(f"/v1/models/{arm}/aliases").json()["items"][0]["history"][0]["before"] is None
    assert delete(api, arm).status_code == 204
    assert publish(api, arm) == 5


def test_deleted_version_is_not_published_by_its_users(api, arm, service):
    """A running query keeps its version; a load, a revision or a snapshot that comes late changes nothing."""
    loaded, held, row = service.loaded, service.loaded.get(arm, 1), registry.find(service.database, arm, 1)
    assert delete(api, f"{arm}/versions/1").status_code == 204
    assert loaded.is_deleted(arm, 1)
    assert loaded._publish(held, registry.Serving(1, 99)) is held
    assert loaded.revise(arm, 1, 5, None) is False
    assert loaded.hot(arm, 1) is None
    assert loaded.newest(arm) != 1
    assert store_snapshot(service, arm, 1) is None
    with pytest.raises(NotFoundError, match="no version '1'"):
        loaded._load(row)


def test_batch_predicted_by_a_deleted_version_is_not_logged(api, arm, service):
    new = make_batch(0)
    arrival = Arrival(new, SimpleNamespace(rows=new.rows, own=slice(0, 1)), False, Placement((0, 1)))
    given = service.learners.monitor(arm), service.loaded.get(arm, None), LearningOptions(), arrival
    assert delete(api, arm).status_code == 204
    with pytest.raises(NotFoundError, match="no model"):
        service.learners._log.append(*given)
    publish(api, arm)
    with pytest.raises(ConflictError, match=r"version 3 .* was deleted meanwhile"):
        service.learners._log.append(*given)


def test_query_survives_alias_move_and_version_deletion(api, arm, service, monkeypatch):
    fresh = LoadedModels(service.storage, LearntVersions(service.database, service.files), capacity=2)
    find, moved = registry.find, threading.Event()

    def find_late(database, model, version):
        if not moved.is_set():  # between reading the alias and reading the version
            moved.set()
            api.put(f"/v1/models/{arm}/aliases/serving", json={"version": 1})
            assert delete(api, f"{arm}/versions/3").status_code == 204
        return find(database, model, version)

    monkeypatch.setattr(registry, "find", find_late)
    assert fresh.get(arm, None).version == 1


@pytest.mark.own_files("damages a file below the home, of which there is another copy")
def test_damaged_files_are_distinguished_from_deleted_ones(api, arm, service):
    (folder(service, arm, 1) / "model.safetensors").write_bytes(b"")
    with pytest.raises(UnreadableVersionError):
        service.loaded.get(arm, 1)
    assert delete(api, f"{arm}/versions/1").status_code == 204


def test_shipped_model_stays_deleted(home):
    database, files = Database.of(Settings(home=home)), Files(home)

    def installed_versions():
        shipped.install_shipped(database, files)
        with database.session() as session:
            return session.scalars(select(tables.VersionRow.version)).all()

    assert [installed_versions() for _ in range(2)] == [[1], [1]]
    with database.transaction() as session:
        for table in (tables.AliasMoveRow, tables.ServingRow, tables.LearnerRow, tables.VersionRow, tables.ModelRow):
            session.query(table).delete()
        session.add(tables.DeletedModelRow(name=shipped.SHIPPED, last_version=1, deleted_at=now()))
    assert installed_versions() == []
    database.close()
