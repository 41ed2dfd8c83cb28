"""The uploaded file of a data set is kept, and read again with other options without another upload."""

import numpy as np
import pytest

from service.datasets import store
from tests.service.data import arrays, columns, csv, error, npz, post, queue, service_of, stream, upload

SAMPLES = stream()
GOOD = csv(columns(SAMPLES))


def read_again(api, dataset, status=201, headers=None, **query):
    answer = api.post(f"/v1/datasets/{dataset['id']}/read", params=query, headers=headers)
    assert answer.status_code == status, answer.text
    return answer.json()


def torques(api, dataset):
    service = service_of(api)
    return store.samples(service.files, store.find(service.database, dataset["id"])).tau


def files_of(api):
    return sorted(path.name for path in service_of(api).files.datasets.iterdir())


def test_options_are_added_to_those_of_the_upload_and_the_old_data_set_goes(strict):
    first = post(strict, GOOD, "text/csv", effort="measured", name="mine").json()
    second = read_again(strict, first, torque_factors="1,-1")
    third = read_again(strict, second, joint_names="a,b", name="other")
    assert (second["name"], third["name"]) == ("mine", "other")
    assert third["report"]["upload_options"] == {"effort": "measured", "torque_factors": "1,-1", "joint_names": "a,b"}
    assert third["report"]["upload_sha256"] == first["report"]["upload_sha256"]
    np.testing.assert_allclose(torques(strict, third), SAMPLES.tau * [1, -1], rtol=1e-12)
    assert [each["id"] for each in strict.get("/v1/datasets").json()["items"]] == [third["id"]]
    assert files_of(strict) == [f"{third['id']}.recording", f"{third['id']}.safetensors"]
    assert read_again(strict, third, torque_factors="1,1")["report"]["upload_options"]["torque_factors"] == "1,1"


def test_data_set_of_a_job_stays_and_its_name_means_the_newest(api):
    first = upload(api, stream(seed=5), name="twice")
    queue(api, "of-a-job", first["id"])
    second = read_again(api, first, joint_names="a,b")
    assert api.get(f"/v1/datasets/{first['id']}").status_code == 200
    assert api.get("/v1/datasets/twice").json()["id"] == second["id"]


def test_wrong_options_leave_the_data_set(strict):
    first = post(strict, npz(**arrays(SAMPLES))).json()
    before = files_of(strict)
    assert read_again(strict, first, 422, torque_factors="1,1,1")["error"]["code"] == "invalid_request"
    assert read_again(strict, first, 422, units="no JSON")["error"]["code"] == "invalid_request"
    assert read_again(strict, {"id": "ds_none"}, 404)["error"]["code"] == "not_found"
    assert files_of(strict) == before
    assert list(service_of(strict).files.uploads.iterdir()) == []


def test_same_request_gives_the_same_data_set(strict):
    first = post(strict, GOOD, "text/csv").json()
    key = {"Idempotency-Key": "once"}
    second = read_again(strict, first, headers=key, joint_names="a,b")
    assert read_again(strict, first, headers=key, joint_names="a,b") == second
    assert len(strict.get("/v1/datasets").json()["items"]) == 1


@pytest.mark.own_files("files are changed below the service")
def test_damaged_or_unknown_file_is_refused(strict):
    first = post(strict, GOOD, "text/csv").json()
    path = service_of(strict).files.datasets / f"{first['id']}.recording"
    path.write_bytes(path.read_bytes()[:-1])
    answer = strict.post(f"/v1/datasets/{first['id']}/read", params={"joint_names": "a,b"})
    assert "does not match its stored sha256" in error(answer, 500, "damaged_data")["message"]
    with service_of(strict).database.transaction() as session:
        row = store.existing(session, first["id"])
        row.report = {key: value for key, value in row.report.items() if key != "upload_options"}
    answer = strict.post(f"/v1/datasets/{first['id']}/read", params={"joint_names": "a,b"})
    assert "was not kept by an earlier release" in error(answer, 409, "conflict")["message"]
