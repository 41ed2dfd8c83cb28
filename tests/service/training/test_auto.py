"""The estimator `auto`: what its job shows while it runs, and what its version keeps."""

import pytest

from lipcore.robots.dirt import Dirt
from tests.service.data import QUICK, stream, train, upload
from tests.service.training.conftest import refresh, version_of

NAMES = ["rigid-body", "rigid-body+local", "lip-chain"]
OPTIONS = {**QUICK, "posterior_samples": 100, "search_seconds": 1.0, "starts": 1}


@pytest.fixture(scope="module")
def auto_model(api):
    dataset = upload(api, stream(samples=120, seed=9, dirt=Dirt()))["id"]
    return train(api, "chosen", dataset, estimator="auto", options=OPTIONS)


@pytest.mark.slow
def test_version_keeps_how_its_estimator_was_chosen(api, auto_model):
    assert (auto_model["estimator"], auto_model["progress"]["fraction"]) == ("auto", 1.0)
    kept = version_of(api, "chosen", auto_model["version"])
    found, held_out = kept["selection"], kept["selection"]["held_out"]
    assert (found["asked"], found["chosen"]) == ("auto", kept["estimator"])
    assert kept["estimator"] in NAMES
    assert [row["estimator"] for row in found["table"]] == NAMES
    assert all(len(row["edge_nmse"]) == 2 for row in found["table"])
    assert held_out["rows"] > 10
    assert (held_out["blocks"], held_out["edge_blocks"]) == (2, 1)
    assert 0 < held_out["edge_rows"] < held_out["rows"]
    assert version_of(api, "panda-sim", 1)["selection"] is None


@pytest.mark.slow
def test_refresh_keeps_the_chosen_estimator(api, auto_model):
    again = refresh(api, "chosen")
    assert again["estimator"] == version_of(api, "chosen", auto_model["version"])["estimator"]
    assert version_of(api, "chosen", again["version"])["selection"] is None
