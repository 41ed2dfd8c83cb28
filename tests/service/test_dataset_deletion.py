"""Deleting data sets."""

import pytest

from tests.service.data import QUICK, error, job, queue, service_of, stream, upload


@pytest.fixture
def dataset(strict):
    """The id of a data set."""
    return upload(strict, stream())["id"]


@pytest.mark.own_files("looks for the file below the home")
def test_deleted_data_set_is_gone_with_its_file(strict, dataset):
    file = service_of(strict).files.datasets / f"{dataset}.safetensors"
    assert file.exists()
    answer = strict.delete(f"/v1/datasets/{dataset}")
    assert (answer.status_code, answer.content) == (204, b"")
    assert not file.exists()
    error(strict.get(f"/v1/datasets/{dataset}"), 404, "not_found")


def test_data_set_of_a_queued_job_is_not_deleted(no_worker, dataset):
    waiting = queue(no_worker, "m", dataset, options={**QUICK, "posterior_samples": 40})
    reply = error(no_worker.delete(f"/v1/datasets/{dataset}"), 409, "conflict")
    assert waiting["id"] in reply["message"]
    assert no_worker.get(f"/v1/datasets/{dataset}").status_code == 200

    no_worker.post(f"/v1/jobs/{waiting['id']}/cancel")
    assert job(no_worker, waiting["id"])["state"] == "cancelled"
    assert no_worker.delete(f"/v1/datasets/{dataset}").status_code == 204
