"""Routes that show the log: lists, single batches, and rows with their codes."""

import numpy as np
import pytest

from lipcore.online.batch import Rows
from lipcore.vocabulary import Code
from service.journal import log
from service.journal.arrivals import NewBatch
from tests.service.learning.learning_models import BATCH_ROWS, observation_batch


@pytest.fixture(scope="module")
def learning_model(learning_service):
    """Model with three batches of one stream, the second with two rejected rows, and one batch of another stream."""
    made = learning_service.create_model("inspected")
    made.send_batches(0)
    q, tau = observation_batch(1)["q"], observation_batch(1)["tau"]
    q[3][1], tau[6][0] = 500.0, None
    made.send_batches(1, q=q, tau=tau)
    made.send_batches(2)
    made.send_batches(0, stream_id="other")
    return made


def list_keys(page):
    return [(item["stream_id"], item["sequence"]) for item in page["items"]]


def test_batches_are_listed_newest_first(learning_model):
    page = learning_model.get("observations")
    assert list_keys(page) == [("other", 0), ("arm", 2), ("arm", 1), ("arm", 0)]
    assert page["next_cursor"] is None
    assert [item["event"] for item in page["items"]] == [4, 3, 2, 1]
    item = page["items"][2]
    assert (item["rows"], item["accepted"], item["rejected"]) == (
        BATCH_ROWS,
        BATCH_ROWS - 2,
        {"limit": 1, "non_finite": 1},
    )
    assert (item["state"], item["version"], item["revision"], item["last_sequence"]) == ("learnt", 1, 1, 1)
    assert item["first_at"] < item["last_at"]


def test_lists_have_pages_and_filters(learning_model):
    first = learning_model.get("observations", limit=3)
    assert list_keys(first) == [("other", 0), ("arm", 2), ("arm", 1)]
    assert list_keys(learning_model.get("observations", limit=3, cursor=first["next_cursor"])) == [("arm", 0)]
    assert list_keys(learning_model.get("observations", stream_id="arm")) == [("arm", 2), ("arm", 1), ("arm", 0)]
    assert list_keys(learning_model.get("observations", rejected=True)) == [("arm", 1)]
    assert list_keys(learning_model.get("observations", rejected=True, stream_id="other")) == []


def test_batch_shows_its_report_and_prediction_figures(learning_model):
    seen = learning_model.get("observations/arm/1")
    reply = learning_model.post(
        "observations",
        observation_batch(
            1,
            q=_replace_value(observation_batch(1)["q"], 3, 1, 500.0),
            tau=_replace_value(observation_batch(1)["tau"], 6, 0, None),
        ),
    )
    assert reply["duplicate"] is True
    assert seen["report"] == reply | {"duplicate": False}
    assert seen["figures"]["rows"] == BATCH_ROWS - 2
    assert all(value > 0 for value in seen["figures"]["rmse"])
    assert (seen["replays"], seen["observed"]) == ([], None)
    outline = learning_model.get("observations", rejected=True)["items"][0]
    assert {name: seen[name] for name in outline} == outline


def test_rows_are_returned_as_sent_with_codes(learning_model):
    seen, sent = learning_model.get("observations/arm/1", rows=True)["observed"], observation_batch(1)
    expected = ["learnt"] * BATCH_ROWS
    expected[3], expected[6] = "limit", "non_finite"
    assert seen["code"] == expected
    for name in ("dq", "ddq"):
        assert seen[name] == sent[name]
    assert seen["q"] == _replace_value(sent["q"], 3, 1, 500.0)
    assert seen["tau"] == _replace_value(sent["tau"], 6, 0, None)
    assert np.diff(seen["time"]) == pytest.approx(np.diff(sent["t"]), abs=1e-5)


def test_frame_is_found_in_its_logged_batch(learning_service):
    learning_model = learning_service.create_model("framed")
    rows = Rows(100.0 + np.arange(5), *np.ones((4, 5, 2)), np.full(5, Code.CONTACT, np.uint8))
    report = {
        "accepted": 0,
        "rejected": {"contact": 5},
        "held": False,
        "open": False,
        "waited": False,
        "departure": None,
        "until": None,
    }
    batch = NewBatch("live", "frames", 20, 24, "0" * 64, 0.0, 100.0, 1, 0, rows, report, None)
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
    learning_model = learning_service.create_model("forgetful")
    learning_model.send_batches(0, 1)
    with learning_service.service.database.transaction() as session:
        session.delete(log.find_batch(session, "forgetful", "arm", 0))
        log.stream(session, "forgetful", "arm").forgotten = 0
    assert "is not in the log" in learning_model.expect_error("GET", "observations/arm/0", 404, "not_found")["message"]


def _replace_value(rows, row, column, value):
    changed = [[*each] for each in rows]
    changed[row][column] = value
    return changed
