"""Services that share files in a bucket: each reads what the others store, and an outage loses nothing."""

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from service.app import create_app
from service.cli.verify import verify_home
from service.models import registry, shipped
from service.models.archive import MEDIA_TYPE
from service.storage.database import Database, VersionRow
from service.storage.files import Files, FilesUnreachableError
from tests.service.data import ADDRESS, arrays, error, npz, post, service_of, stream, upload
from tests.system.cluster.servers import BUCKET, Shared

ZEROS = [[0.0] * 7]
QUERY = {"q": ZEROS, "dq": ZEROS, "ddq": ZEROS}


@contextmanager
def service(shared: Shared, name: str = "home", **more: Any) -> Iterator[Any]:
    """Start a service in this process."""
    with TestClient(create_app(shared.settings(name, **more)), ADDRESS) as api:
        yield api


@contextmanager
def outage(shared: Shared) -> Iterator[None]:
    """Stop the bucket for a while."""
    shared.s3.stop()
    try:
        yield
    finally:
        shared.s3.start()


def states(api):
    """Return the state of each part of a service, by name."""
    found = service_of(api)
    found.readiness.forget()
    return {each.name: each.state for each in found.readiness.report()}


def test_bucket_outage_is_reported_and_ends_by_itself(shared, caplog):
    caplog.set_level(logging.DEBUG)
    with service(shared) as api:
        kept = upload(api, stream())
        other = upload(api, stream(seed=2))
        before = shared.stored()
        with outage(shared):
            body = npz(**arrays(stream(seed=3)), joint_names=list(stream().joint_names))
            refused = post(api, body)
            error(refused, 503, "storage_unavailable")
            assert int(refused.headers["retry-after"]) >= 1
            assert api.post("/v1/models/panda-sim/predict", json=QUERY).status_code == 200  # from memory
            assert api.get(f"/v1/datasets/{kept['id']}/preview").status_code == 200  # from the copy
            assert states(api)["files"] == "warning"
            assert api.get("/health/ready").status_code == 200
            assert api.delete(f"/v1/datasets/{other['id']}").status_code == 204  # its file is deleted later
        assert states(api)["files"] == "ok"
        assert post(api, body).status_code == 201
        assert set(before) < set(shared.stored())
        assert len(api.get("/v1/datasets").json()["items"]) == 2
    assert shared.s3.env["AWS_SECRET_ACCESS_KEY"] not in caplog.text


def test_files_of_one_service_are_used_by_another(shared):
    with service(shared, "one") as one, service(shared, "two") as two:
        dataset = upload(one, stream())
        assert two.get(f"/v1/datasets/{dataset['id']}/preview").status_code == 200
        archive = two.get("/v1/models/panda-sim/export").content
        kind = {"content-type": MEDIA_TYPE}
        made = one.post(
            "/v1/models/import", content=archive, headers=kind, params={"name": "moved", "promotion": "always"}
        )
        assert made.status_code == 201, made.text
        same = [api.post("/v1/models/moved/predict", json=QUERY).json() for api in (one, two)]
        assert same[0] == same[1]
        assert two.delete("/v1/models/moved").status_code == 204
        assert two.delete(f"/v1/datasets/{dataset['id']}").status_code == 204
        folder = registry.find(service_of(one).database, "panda-sim", 1).folder
        prefix = f"{shared.prefix}/versions/{folder}/"
        assert shared.stored() == [f"{prefix}manifest.json", f"{prefix}model.safetensors"]
        error(one.get(f"/v1/datasets/{dataset['id']}/preview"), 404, "not_found")


def test_services_starting_together_install_one_shipped_model(shared):
    opened = [(Database.of(settings), Files.of(settings)) for settings in map(shared.settings, ("a", "b", "c"))]
    barrier = threading.Barrier(len(opened))

    def start(database, files):
        barrier.wait()
        shipped.install_shipped(database, files)

    threads = [threading.Thread(target=start, args=each) for each in opened]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with opened[0][0].session() as session:
        (row,) = session.scalars(select(VersionRow))
    assert {key.split("/")[2] for key in shared.stored()} == {row.folder}
    for database, _ in opened:
        database.close()


def test_shared_files_are_verified(shared):
    settings = shared.settings("one")
    with service(shared, "one") as api:
        dataset = upload(api, stream())
        registry.find(service_of(api).database, "panda-sim", 1)
    assert verify_home(settings).damages == []
    client, key = shared.s3.client(), f"{shared.prefix}/datasets/{dataset['id']}.safetensors"
    client.put_object(Bucket=BUCKET, Key=key, Body=b"something else")
    (found,) = verify_home(settings).damages  # although this host has an undamaged copy
    assert (found.kind, found.name) == ("dataset", dataset["id"])
    with outage(shared), pytest.raises(FilesUnreachableError):  # says nothing about the files
        verify_home(settings)
