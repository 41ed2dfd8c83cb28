"""The log as its owner sees it: lists, single batches, rows with their codes."""

import numpy as np
import pytest

from lipcore.online.batch import Rows
from lipcore.vocabulary import Code
from service.journal import log
from service.journal.arrivals import NewBatch
from tests.service.learning.lessons import LESSON, lesson


@pytest.fixture(scope="module")
def pupil(school):
    """A model with three batches of one stream, the second with two rows kept out, and one of another."""
    made = school.enrol("inspected")
    made.teach(0)
    q, tau = lesson(1)["q"], lesson(1)["tau"]
    q[3][1], tau[6][0] = 500.0, None
    made.teach(1, q=q, tau=tau)
    made.teach(2)
    made.teach(0, stream_id="other")
    return made


def keys(page):
    return [(item["stream_id"], item["sequence"]) for item in page["items"]]


def test_batches_are_listed_newest_first(pupil):
    page = pupil.get("observations")
    assert keys(page) == [("other", 0), ("arm", 2), ("arm", 1), ("arm", 0)]
    assert page["next_cursor"] is None
    assert [item["event"] for item in page["items"]] == [4, 3, 2, 1]
    item = page["items"][2]
    assert (item["rows"], item["accepted"], item["rejected"]) == (LESSON, LESSON - 2, {"limit": 1, "non_finite": 1})
    assert (item["state"], item["version"], item["revision"], item["last_sequence"]) == ("learnt", 1, 1, 1)
    assert item["first_at"] < item["last_at"]


def test_pages_and_filters(pupil):
    first = pupil.get("observations", limit=3)
    assert keys(first) == [("other", 0), ("arm", 2), ("arm", 1)]
    assert keys(pupil.get("observations", limit=3, cursor=first["next_cursor"])) == [("arm", 0)]
    assert keys(pupil.get("observations", stream_id="arm")) == [("arm", 2), ("arm", 1), ("arm", 0)]
    assert keys(pupil.get("observations", rejected=True)) == [("arm", 1)]
    assert keys(pupil.get("observations", rejected=True, stream_id="other")) == []


def test_a_batch_tells_what_was_said_and_how_it_was_predicted(pupil):
    seen = pupil.get("observations/arm/1")
    said = pupil.post(
        "observations", lesson(1, q=_with(lesson(1)["q"], 3, 1, 500.0), tau=_with(lesson(1)["tau"], 6, 0, None))
    )
    assert said["duplicate"] is True
    assert seen["report"] == said | {"duplicate": False}
    assert seen["figures"]["rows"] == LESSON - 2
    assert all(value > 0 for value in seen["figures"]["rmse"])
    assert (seen["replays"], seen["observed"]) == ([], None)
    outline = pupil.get("observations", rejected=True)["items"][0]
    assert {name: seen[name] for name in outline} == outline


def test_rows_come_as_they_were_sent_with_their_codes(pupil):
    seen, sent = pupil.get("observations/arm/1", rows=True)["observed"], lesson(1)
    expected = ["learnt"] * LESSON
    expected[3], expected[6] = "limit", "non_finite"
    assert seen["code"] == expected
    for name in ("dq", "ddq"):
        assert seen[name] == sent[name]
    assert seen["q"] == _with(sent["q"], 3, 1, 500.0)
    assert seen["tau"] == _with(sent["tau"], 6, 0, None)
    assert np.diff(seen["time"]) == pytest.approx(np.diff(sent["t"]), abs=1e-5)


def test_a_frame_is_found_in_the_batch_it_was_logged_with(school):
    pupil = school.enrol("framed")
    rows = Rows(100.0 + np.arange(5), *np.ones((4, 5, 2)), np.full(5, Code.CONTACT, np.uint8))
    said = {
        "accepted": 0,
        "rejected": {"contact": 5},
        "held": False,
        "open": False,
        "waited": False,
        "departure": None,
        "until": None,
    }
    batch = NewBatch("live", "frames", 20, 24, "0" * 64, 0.0, 100.0, 1, 0, rows, said, None)
    with school.service.database.transaction() as session:
        log.append_batch(session, "framed", batch)
    seen = pupil.get("observations/live/22", rows=True)
    assert (seen["sequence"], seen["last_sequence"], seen["figures"]) == (20, 24, None)
    assert (seen["rows"], seen["accepted"], seen["observed"]["code"]) == (5, 0, ["contact"] * 5)
    pupil.refused("GET", "observations/live/25", 404, "not_found")
    body = pupil.refused("DELETE", "observations/live/22", 422, "invalid_request")
    assert "frames 20 to 24 were logged together" in body["message"]


@pytest.mark.parametrize("path", ["observations/arm/9", "observations/nobody/0"])
def test_what_has_not_come_is_not_found(pupil, path):
    for method in ("GET", "DELETE"):
        assert pupil.refused(method, path, 404, "not_found")["detail"][0]["field"] == "batch"
    pupil.refused("POST", f"{path}/replay", 404, "not_found", json={})


def test_a_batch_that_is_no_longer_kept_is_said_to_be_gone(school):
    pupil = school.enrol("forgetful")
    pupil.teach(0, 1)
    with school.service.database.transaction() as session:
        session.delete(log.find_batch(session, "forgetful", "arm", 0))
        log.stream(session, "forgetful", "arm").forgotten = 0
    assert "no longer kept" in pupil.refused("GET", "observations/arm/0", 404, "not_found")["message"]


def _with(rows, row, column, value):
    changed = [[*each] for each in rows]
    changed[row][column] = value
    return changed
