"""A job with the estimator `auto`: what it shows while it runs, and what its version keeps."""

from __future__ import annotations

import json

import pytest

from lipcore.fitting.hyperparameters import FitProgress
from service.training.pulse import LEAST_FRACTION, Remaining
from tests.service.data import QUICK, ended, job, queue, stream, train, upload

NAMES = ["rigid-body", "rigid-body+lip-chain", "lip-chain"]
OPTIONS = {**QUICK, "posterior_samples": 100, "search_seconds": 1.0, "starts": 1}


@pytest.fixture(scope="module")
def made(api):
    dataset = upload(api, stream(samples=120, seed=9))["id"]
    return train(api, "chosen", dataset, estimator="auto", options=OPTIONS)


def test_the_version_keeps_how_its_estimator_was_chosen(api, made):
    assert made["estimator"] == "auto"
    version = api.get(f"/v1/models/chosen/versions/{made['version']}").json()
    found = version["selection"]
    assert (found["asked"], found["chosen"]) == ("auto", version["estimator"])
    assert version["estimator"] in NAMES
    assert [row["estimator"] for row in found["table"]] == NAMES
    assert found["held_out"]["rows"] > 10
    assert found["held_out"]["blocks"] == 2
    assert made["progress"]["fraction"] == 1.0
    assert api.get("/v1/models/panda-sim").status_code == 200
    assert api.get("/v1/models/panda-sim/versions/1").json()["selection"] is None


def test_a_refresh_keeps_the_chosen_estimator(api, made):
    asked = api.post("/v1/models/chosen/refresh", json={})
    assert asked.status_code == 202, asked.text
    again = ended(api, asked.json()["id"])
    chosen = api.get(f"/v1/models/chosen/versions/{made['version']}").json()["estimator"]
    assert again["estimator"] == chosen
    assert again["state"] == "succeeded", again
    assert api.get(f"/v1/models/chosen/versions/{again['version']}").json()["selection"] is None


def test_the_choice_goes_with_an_archive(api, made):
    archive = api.get("/v1/models/chosen/export", params={"version": made["version"]})
    headers = {"content-type": "application/x-tar"}
    answer = api.post("/v1/models/import", content=archive.content, headers=headers, params={"name": "carried"})
    assert answer.status_code == 201, answer.text
    version = api.get(f"/v1/models/carried/versions/{answer.json()['version']}").json()
    assert version["selection"] == api.get(f"/v1/models/chosen/versions/{made['version']}").json()["selection"]


def test_it_can_be_cancelled(api):
    dataset = upload(api, stream("panda", 200, seed=82))["id"]
    name = queue(api, "cut", dataset, estimator="auto", options={"search_seconds": 60.0})["id"]
    api.post(f"/v1/jobs/{name}/cancel")
    assert ended(api, name)["state"] == "cancelled"
    assert job(api, name)["version"] is None


def test_the_time_that_is_left_of_several_fits_is_that_of_their_share():
    left = Remaining(100, 500)
    left.step(FitProgress("geometry", 1, 150, 0.0, LEAST_FRACTION / 2, 1.0, "rigid-body"), 11.0)
    assert left.seconds(11.0) is None
    left.step(FitProgress("hyperparameters", 3, 150, 0.0, 0.25, 20.0, "lip-chain"), 30.0)
    assert left.seconds(30.0) == pytest.approx(60.0)


def test_the_choice_is_shown_as_a_table(api, made):
    from service.cli.tables import selection_table
    from service.models.schema import Selection

    found = api.get(f"/v1/models/chosen/versions/{made['version']}").json()["selection"]
    table = selection_table(Selection.model_validate(json.loads(json.dumps(found))))
    assert table.row_count == 3
    assert table.title == "judged on 2 stretches that the training did not see"
    assert f"{found['chosen']} (chosen)" in [str(cell) for cell in table.columns[0].cells]
