"""Finding data sets again, page by page, and deleting them."""

import pytest

from tests.service.data import QUICK, error, job, queue, service_of, stream, upload


@pytest.fixture
def datasets(strict):
    """Five data sets, the oldest first."""
    return [upload(strict, stream(seed=seed), name=str(seed))["id"] for seed in range(1, 6)]


def pages(api, path, limit):
    """All pages of a list."""
    cursor, result = None, []
    while True:
        body = api.get(path, params={"limit": limit} | ({"cursor": cursor} if cursor else {})).json()
        assert set(body) == {"items", "next_cursor"}
        result.append(body["items"])
        cursor = body["next_cursor"]
        if cursor is None:
            return result


@pytest.mark.parametrize(("limit", "sizes"), [(1, [1] * 5), (3, [3, 2])])
def test_pages_hold_every_data_set_once_newest_first(strict, datasets, limit, sizes):
    result = pages(strict, "/v1/datasets", limit)
    assert [len(page) for page in result] == sizes
    assert [item["id"] for page in result for item in page] == datasets[::-1]


@pytest.mark.own_files("looks for the file below the home")
def test_deleted_data_set_is_gone_with_its_file(strict, datasets):
    file = service_of(strict).files.datasets / f"{datasets[0]}.safetensors"
    assert file.exists()
    answer = strict.delete(f"/v1/datasets/{datasets[0]}")
    assert (answer.status_code, answer.content) == (204, b"")
    assert not file.exists()
    error(strict.get(f"/v1/datasets/{datasets[0]}"), 404, "not_found")


def test_data_set_of_a_queued_job_is_not_deleted(no_worker, datasets):
    waiting = queue(no_worker, "m", datasets[0], options={**QUICK, "posterior_samples": 40})
    reply = error(no_worker.delete(f"/v1/datasets/{datasets[0]}"), 409, "conflict")
    assert waiting["id"] in reply["message"]
    assert no_worker.get(f"/v1/datasets/{datasets[0]}").status_code == 200

    no_worker.post(f"/v1/jobs/{waiting['id']}/cancel")
    assert job(no_worker, waiting["id"])["state"] == "cancelled"
    assert no_worker.delete(f"/v1/datasets/{datasets[0]}").status_code == 204
