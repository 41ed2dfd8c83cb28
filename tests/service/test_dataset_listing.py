"""Finding data sets again, page by page, and deleting them."""

from __future__ import annotations

import pytest

from tests.service.data import QUICK, error, job, queue, service_of, stream, train, upload


@pytest.fixture
def datasets(strict):
    """Five data sets, the oldest first."""
    return [upload(strict, stream(seed=seed), name=str(seed))["id"] for seed in range(1, 6)]


def pages(api, path, limit):
    """All pages of a list."""
    cursor, found = None, []
    while True:
        body = api.get(path, params={"limit": limit} | ({"cursor": cursor} if cursor else {})).json()
        assert set(body) == {"items", "next_cursor"}
        found.append(body["items"])
        cursor = body["next_cursor"]
        if cursor is None:
            return found


@pytest.mark.parametrize(("limit", "sizes"), [(1, [1] * 5), (2, [2, 2, 1]), (3, [3, 2])])
def test_pages_hold_every_data_set_once_newest_first(strict, datasets, limit, sizes):
    found = pages(strict, "/v1/datasets", limit)
    assert [len(page) for page in found] == sizes
    assert [item["id"] for page in found for item in page] == datasets[::-1]


def test_a_full_last_page_has_no_next(strict, datasets):
    strict.delete(f"/v1/datasets/{datasets[0]}")
    strict.delete(f"/v1/datasets/{datasets[1]}")
    assert [len(page) for page in pages(strict, "/v1/datasets", 3)] == [3]


def test_what_is_uploaded_meanwhile_does_not_shift_the_pages(strict, datasets):
    first = strict.get("/v1/datasets", params={"limit": 2}).json()
    datasets.append(upload(strict, stream(seed=9))["id"])
    second = strict.get("/v1/datasets", params={"limit": 3, "cursor": first["next_cursor"]}).json()
    assert [item["id"] for item in second["items"]] == datasets[2::-1]


@pytest.mark.parametrize("path", ["/v1/datasets", "/v1/jobs", "/v1/models"])
@pytest.mark.parametrize(
    ("params", "field"),
    [
        ({"limit": 0}, "limit"),
        ({"limit": 4}, "limit"),
        ({"limit": "x"}, "limit"),
        ({"cursor": "x"}, "cursor"),
        ({"cursor": "-1"}, "cursor"),
        ({"cursor": "٣"}, "cursor"),
        ({"cursor": "9" * 30}, "cursor"),
    ],
)
def test_bad_pages_are_refused(strict, path, params, field):
    assert error(strict.get(path, params=params), 422, "invalid_request")["detail"][0]["field"] == field


def test_list_and_get_show_the_same(strict, datasets):
    shown = strict.get(f"/v1/datasets/{datasets[-1]}").json()
    assert strict.get("/v1/datasets", params={"limit": 1}).json()["items"] == [shown]


def test_unknown_data_set_is_not_found(strict):
    for answer in (strict.get("/v1/datasets/ds_x"), strict.delete("/v1/datasets/ds_x")):
        assert "ds_x" in error(answer, 404, "not_found")["message"]


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
    said = error(no_worker.delete(f"/v1/datasets/{datasets[0]}"), 409, "conflict")
    assert waiting["id"] in said["message"]
    assert no_worker.get(f"/v1/datasets/{datasets[0]}").status_code == 200

    no_worker.post(f"/v1/jobs/{waiting['id']}/cancel")
    assert job(no_worker, waiting["id"])["state"] == "cancelled"
    assert no_worker.delete(f"/v1/datasets/{datasets[0]}").status_code == 204


def test_a_model_outlives_its_data_set(api):
    dataset = upload(api, stream(seed=8))["id"]
    train(api, "survivor", dataset)
    assert api.delete(f"/v1/datasets/{dataset}").status_code == 204
    query = {"q": [0.1, 0.2], "dq": [0, 0], "ddq": [0, 0]}
    assert api.post("/v1/models/survivor/predict", json=query).status_code == 200
    assert api.get("/v1/models/survivor/versions/1").json()["lineage"]["datasets"][0]["id"] == dataset
