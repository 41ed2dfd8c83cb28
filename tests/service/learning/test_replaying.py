"""Rows that were kept out can be learnt after all, once."""

from __future__ import annotations

import numpy as np
import pytest

from service.journal import log
from service.journal.log import decode
from tests.service.learning.lessons import LESSON, apart, lesson

EQUAL = 1e-8
PUSHED = slice(2, 6)
"""Rows of a lesson during which something pushes."""


def pushed(number):
    """Torques of a lesson with a push that the model cannot explain."""
    tau = np.array(lesson(number)["tau"])
    tau[PUSHED] += 50.0
    return tau.tolist()


def test_replayed_rows_teach_as_if_they_had_been_let_in(school):
    wary, trusting = school.enrol("wary", contact_threshold=8.0), school.enrol("trusting")
    wary.teach(0)
    said = wary.teach(1, tau=pushed(1))
    assert (said["accepted"], said["rejected"]) == (6, {"contact": 4})
    kept_out = wary.predict()
    said = wary.post("observations/arm/1/replay", {"codes": ["contact"]})
    assert said == {
        "model": "wary",
        "version": 1,
        "revision": 3,
        "stream_id": "arm",
        "sequence": 1,
        "rows": 4,
        "codes": {"contact": 4},
    }
    learnt = wary.settled(said["revision"])
    trusting.teach(0)
    trusting.teach(1, tau=pushed(1))
    expected = trusting.predict()
    assert apart(learnt, expected) < EQUAL
    assert apart(kept_out, expected) > 1e3 * EQUAL
    seen = wary.get("observations/arm/1", rows=True)
    assert [(each["event"], each["codes"], each["rows"], each["state"]) for each in seen["replays"]] == [
        (3, ["contact"], 4, "learnt")
    ]
    assert seen["rejected"] == {"contact": 4}  # what was said of it stays


def test_a_row_is_replayed_once(school):
    pupil = school.enrol("once", contact_threshold=8.0)
    q = lesson(0)["q"]
    q[9][0] = 13.0
    pupil.teach(0, tau=pushed(0), q=q)
    assert pupil.post("observations/arm/0/replay", {"codes": ["contact"]})["codes"] == {"contact": 4}
    body = pupil.refused("POST", "observations/arm/0/replay", 409, "conflict", json={"codes": ["contact"]})
    assert "contact have been replayed" in body["message"]
    assert pupil.post("observations/arm/0/replay", {})["codes"] == {"limit": 1}  # what is left
    body = pupil.refused("POST", "observations/arm/0/replay", 409, "conflict", json={})
    assert "contact" in body["message"]
    assert "limit" in body["message"]
    assert pupil.get("learning")["status"]["events"] == 3


def test_rows_without_all_numbers_are_never_learnt(school):
    pupil = school.enrol("incomplete")
    tau = lesson(0)["tau"]
    tau[1][1] = None
    pupil.teach(0, tau=tau)
    body = pupil.refused("POST", "observations/arm/0/replay", 422, "invalid_request", json={"codes": ["non_finite"]})
    assert body["detail"][0]["value"] == "non_finite"
    body = pupil.refused("POST", "observations/arm/0/replay", 422, "invalid_request", json={})
    assert "there are none" in body["message"]


@pytest.mark.parametrize("codes", [["edge"], ["learnt"], ["contact", "nonsense"], [], "contact"])
def test_only_codes_of_complete_rows_are_taken(school, codes):
    pupil = school.enrol(f"codes-{len(str(codes))}")
    pupil.teach(0)
    body = pupil.refused("POST", "observations/arm/0/replay", 422, "invalid_request", json={"codes": codes})
    assert body["detail"][0]["field"].startswith("codes")


def test_a_batch_without_such_rows_names_those_it_has(school):
    pupil = school.enrol("other-codes", contact_threshold=8.0)
    pupil.teach(0, tau=pushed(0))
    body = pupil.refused("POST", "observations/arm/0/replay", 422, "invalid_request", json={"codes": ["saturation"]})
    assert (body["detail"][0]["field"], body["detail"][0]["value"]) == ("codes", "saturation")
    assert body["detail"][0]["expected"].endswith("contact")


def test_what_was_undone_is_not_replayed(school):
    pupil = school.enrol("undone", contact_threshold=8.0)
    pupil.teach(0, tau=pushed(0))
    pupil.delete("observations/arm/0")
    assert "unlearnt" in pupil.refused("POST", "observations/arm/0/replay", 409, "conflict", json={})["message"]


def test_a_replay_that_was_rolled_back_can_be_made_again(school):
    pupil = school.enrol("again", contact_threshold=8.0)
    pupil.teach(0, tau=pushed(0))
    pupil.teach(1)
    pupil.settled(pupil.post("observations/arm/0/replay", {})["revision"])
    learnt = pupil.predict()
    pupil.settled(pupil.post("rollback", {"revision": 2})["revision"])
    again = pupil.settled(pupil.post("observations/arm/0/replay", {})["revision"])
    assert apart(again, learnt) < EQUAL
    assert [each["state"] for each in pupil.get("observations/arm/0")["replays"]] == ["rolled_back", "learnt"]


def test_rows_whose_time_was_wrong_count_as_of_their_arrival(school):
    pupil = school.enrol("jumped")
    times = lesson(0)["t"]
    times[5] = 1e9
    said = pupil.teach(0, t=times)
    jumped = said["rejected"]["time_jump"]
    assert pupil.post("observations/arm/0/replay", {"codes": ["time_jump"]})["rows"] == jumped
    with school.service.database.session() as session:
        [batch, replay] = log.events(session, "jumped", 0, 10)
    rows = decode(replay.payload)
    assert np.all(rows.time == batch.received)
    assert np.all(rows.code == 0)
    assert len(rows) == jumped <= LESSON
