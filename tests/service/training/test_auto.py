"""The estimator `auto`: what its job shows while it runs, and what its version keeps."""

import pytest

from lipcore.robots.dirt import Dirt
from tests.service.data import QUICK, ended, stream, train, upload

NAMES = ["rigid-body", "rigid-body+local", "lip-chain"]
OPTIONS = {**QUICK, "posterior_samples": 100, "search_seconds": 1.0, "starts": 1}


@pytest.fixture(scope="module")
def auto_model(api):
    dataset = upload(api, stream(samples=120, seed=9, dirt=Dirt()))["id"]
    return train(api, "chosen", dataset, estimator="auto", options=OPTIONS)


@pytest.mark.slow
def test_version_keeps_how_its_estimator_was_chosen(api, auto_model):
    assert auto_model["estimator"] == "auto"
    version = api.get(f"/v1/models/chosen/versions/{auto_model['version']}").json()
    found = version["selection"]
    assert (found["asked"], found["chosen"]) == ("auto", version["estimator"])
    assert version["estimator"] in NAMES
    assert [row["estimator"] for row in found["table"]] == NAMES
    assert all(len(row["edge_nmse"]) == 2 for row in found["table"])
    assert found["held_out"]["rows"] > 10
    assert (found["held_out"]["blocks"], found["held_out"]["edge_blocks"]) == (2, 1)
    assert 0 < found["held_out"]["edge_rows"] < found["held_out"]["rows"]
    assert auto_model["progress"]["fraction"] == 1.0
    assert api.get("/v1/models/panda-sim").status_code == 200
    assert api.get("/v1/models/panda-sim/versions/1").json()["selection"] is None


@pytest.mark.slow
def test_refresh_keeps_the_chosen_estimator(api, auto_model):
    answer = api.post("/v1/models/chosen/refresh", json={})
    assert answer.status_code == 202, answer.text
    again = ended(api, answer.json()["id"])
    chosen = api.get(f"/v1/models/chosen/versions/{auto_model['version']}").json()["estimator"]
    assert again["estimator"] == chosen
    assert again["state"] == "succeeded", again
    assert api.get(f"/v1/models/chosen/versions/{again['version']}").json()["selection"] is None
