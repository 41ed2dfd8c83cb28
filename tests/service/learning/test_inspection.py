"""Routes that show the log: lists, single batches, and rows with their codes."""

import numpy as np
import pytest

from lipcore.online.batch import Rows
from lipcore.vocabulary import Code
from service.journal import log
from tests.service.learning.batches import make_batch
from tests.service.learning.learning_models import BATCH_ROWS, observation_batch


def broken_batch():
    """Return batch 1 with a position out of its limits in row 3 and without a torque in row 6."""
    body = observation_batch(1)
    body["q"][3][1], body["tau"][6][0] = 500.0, None
    return body


@pytest.fixture(scope="module")
def learning_model(learning_service):
    """Model with three batches of one stream, the second with two rejected rows, and one batch of another stream."""
    made = learning_service.create_model("inspected")
    made.send_batches(0)
    made.post("observations", broken_batch())
    made.send_batches(2)
    made.send_batches(0, stream_id="other")
    return made


def test_batches_are_listed_newest_first(learning_model):
    page = learning_model.get("observations")
    assert page["next_cursor"] is None
    assert [item["event"] for item in page["items"]] == [4, 3, 2, 1]
    item = page["items"][2]
    assert (item["rows"], item["accepted"]) == (BATCH_ROWS, BATCH_ROWS - 2)
    assert item["rejected"] == {"limit": 1, "non_finite": 1}
    assert (item["state"], item["version"], item["revision"], item["last_sequence"]) == ("learnt", 1, 1, 1)
    assert item["first_at"] < item["last_at"]


def test_lists_have_pages_and_filters(learning_model):
    def list_batches(**params):
        page = learning_model.get("observations", **params)
        return [f"{item['stream_id']} {item['sequence']}" for item in page["items"]], page["next_cursor"]

    first, cursor = list_batches(limit=3)
    assert first == ["other 0", "arm 2", "arm 1"]
    for params, expected in (
        ({}, ["other 0", "arm 2", "arm 1", "arm 0"]),
        ({"limit": 3, "cursor": cursor}, ["arm 0"]),
        ({"stream_id": "arm"}, ["arm 2", "arm 1", "arm 0"]),
        ({"rejected": True}, ["arm 1"]),
        ({"rejected": True, "stream_id": "other"}, []),
    ):
        assert list_batches(**params)[0] == expected, params


def test_batch_shows_its_report_and_prediction_figures(learning_model):
    seen = learning_model.get("observations/arm/1")
    reply = learning_model.post("observations", broken_batch())
    assert reply["duplicate"] is True
    assert seen["report"] == reply | {"duplicate": False}
    assert seen["figures"]["rows"] == BATCH_ROWS - 2
    assert all(value > 0 for value in seen["figures"]["rmse"])
    assert (seen["replays"], seen["observed"]) == ([], None)
    outline = learning_model.get("observations", rejected=True)["items"][0]
    assert {name: seen[name] for name in outline} == outline


def test_rows_are_returned_as_sent_with_codes(learning_model):
    seen, sent = learning_model.get("observations/arm/1", rows=True)["observed"], broken_batch()
    codes = {3: "limit", 6: "non_finite"}
    assert seen["code"] == [codes.get(row, "learnt") for row in range(BATCH_ROWS)]
    for name in ("q", "dq", "ddq", "tau"):
        assert seen[name] == sent[name]
    assert np.diff(seen["time"]) == pytest.approx(np.diff(sent["t"]), abs=1e-5)


def test_frame_is_found_in_its_logged_batch(learning_service):
    learning_model = learning_service.create_model("framed")
    rows = Rows(100.0 + np.arange(5), *np.ones((4, 5, 2)), np.full(5, Code.CONTACT, np.uint8))
    flags = {"held": False, "open": False, "waited": False, "departure": None, "until": None}
    report = {"accepted": 0, "rejected": {"contact": 5}, **flags}
    batch = make_batch(20, last=24, stream_id="live", received=100.0, rows=rows, report=report, record=None)
    with learning_service.service.database.transaction() as session:
        log.append_batch(session, "framed", batch)
    seen = learning_model.get("observations/live/22", rows=True)
    assert (seen["sequence"], seen["last_sequence"], seen["figures"]) == (20, 24, None)
    assert (seen["rows"], seen["accepted"], seen["observed"]["code"]) == (5, 0, ["contact"] * 5)
    learning_model.expect_error("GET", "observations/live/25", 404, "not_found")
    body = learning_model.expect_error("DELETE", "observations/live/22", 422, "invalid_request")
    assert "Frames 20 to 24 were logged together" in body["message"]


@pytest.mark.parametrize("path", ["observations/arm/9", "observations/nobody/0"])
def test_unknown_batches_are_not_found(learning_model, path):
    for method in ("GET", "DELETE"):
        assert learning_model.expect_error(method, path, 404, "not_found")["detail"][0]["field"] == "batch"
    learning_model.expect_error("POST", f"{path}/replay", 404, "not_found", json={})


def test_expired_batch_is_reported_as_no_longer_kept(learning_service):
    learning_model = learning_service.create_model()
    learning_model.send_batches(0, 1)
    learning_model.delete_from_log(0)
    assert "is not in the log" in learning_model.expect_error("GET", "observations/arm/0", 404, "not_found")["message"]
