"""How a stream begins: one that does not fit the model from its first row on is said so, and not learnt."""

import numpy as np
import pytest
from scipy.stats import binom

from lipcore.online.changes.opening import OPENING, Opening
from tests.service.learning import lessons
from tests.service.learning.lessons import Pupil, apart
from tests.service.learning.recordings import codes
from tests.service.learning.test_changes import BATCH, WATCHFUL, drive

OFF = 0.05
"""N·m: five times the noise, which is no contact."""


def opened(inside: float, rows: float = OPENING.rows, joints: int = 3) -> Opening:
    """An opening of rows of a tenth of a second, that share of which the intervals of all joints held."""
    count = round(rows)
    error = np.where(np.arange(count)[:, None] < inside * count, 1.0, 3.0) * np.ones(joints)
    return Opening.start(joints).step(np.arange(count) / 10, np.ones(count), error, np.ones((count, joints)))


def test_rows_count_as_far_as_they_are_independent():
    rng = np.random.default_rng(3)
    error, spread = rng.standard_normal((250, 2)) * [1.0, 3.0], rng.uniform(0.5, 2.0, (250, 2))
    time, weight = np.arange(250) / 100, np.full(250, 0.1)
    opening = Opening.start(2)
    for rows in np.split(np.arange(250), [30, 31, 95, 140]):
        opening = opening.step(time[rows], weight[rows], error[rows], spread[rows])
    first = slice(0, 100)  # a second
    held = np.abs(error[first]) <= OPENING.band * spread[first]
    assert opening.is_complete
    np.testing.assert_allclose(opening.coverage, held.mean(axis=0))
    assert (opening.rows, opening.since) == (pytest.approx(OPENING.rows), 0.0)
    assert Opening.from_json(opening.to_json()).to_json() == opening.to_json()


def test_only_what_is_known_to_be_far_outside_is_a_misfit():
    """Known: where the intervals hold the min share, so few or fewer come once in forty streams at most."""
    for hits in range(11):
        chance = binom.cdf(hits, 10, OPENING.min_share)
        assert opened(hits / 10).is_misfit == (chance < 0.025)
    assert opened(0.0).joints == (0, 1, 2)
    assert not opened(0.0, rows=OPENING.rows - 1).is_misfit  # it has not been a second yet


def test_joints_are_no_witnesses_of_their_own():
    """One joint of three that is off is told by other means: its errors may last for a second."""
    error = np.ones((10, 3)) * [9.0, 1.0, 1.0]
    opening = Opening.start(3).step(np.arange(10) / 10, np.ones(10), error, np.ones((10, 3)))
    assert (opening.is_misfit, opening.joints) == (False, (0,))


@pytest.fixture(scope="module")
def strange(school):
    """A model that a stream of another robot was sent to; what was said, and what it had answered before."""
    pupil = school.enrol("strange", **WATCHFUL, on_change="hold")
    before = pupil.predict()
    return pupil, drive(pupil, range(4), push=OFF), before


def test_a_stream_that_begins_outside_the_band_is_held_after_a_second(strange):
    _, said, _ = strange
    assert [each["held"] for each in said] == [False, True, True, True]
    assert [each["rejected"] for each in said[1:]] == [{"change": BATCH}] * 3


def test_its_first_second_is_taken_out_again(strange):
    pupil, _, before = strange
    after = pupil.settled(pupil.get("learning")["status"]["revision"])
    assert apart(after, before) < 1e-9
    (first, *_) = pupil.get("observations", stream_id="arm")["items"][::-1]
    assert first["state"] == "unlearnt"


def test_the_owner_is_told_how_it_began(strange):
    pupil, _, _ = strange
    (alarm,) = pupil.get("alarms")["items"]
    evidence = alarm["evidence"]
    assert alarm["kind"] == "change"
    assert "stream arm does not fit the model: " in alarm["message"]
    assert "nothing is learnt until its owner has decided" in alarm["message"]
    assert (evidence["kind"], evidence["stream_id"], evidence["joints"]) == ("opening", "arm", ["joint1", "joint2"])
    assert evidence["coverage"] == pytest.approx(np.mean(list(evidence["joint_coverage"].values())))
    assert evidence["coverage"] < 0.15
    assert pupil.get("learning")["status"]["held"]["evidence"] == evidence


def test_its_errors_widen_no_other_answers(strange, school):
    """The answers to its own questions are wide; those of others are not about this robot."""
    pupil, _, before = strange
    assert pupil.predict()["scale"] == before["scale"]
    scales = school.service.loaded.get(pupil.model, None).scales
    assert (scales.of("arm") > 2 * scales.of(None)).all()
    pupil.post("learning/change", {"decision": "ignore"})
    drive(pupil, range(4, 5), push=OFF)
    assert (np.array(pupil.predict()["scale"]) > 2 * np.array(before["scale"])).all()


def test_once_confirmed_it_is_learnt(school):
    pupil = school.enrol("confirmed", **WATCHFUL, on_change="hold")
    drive(pupil, range(3), push=OFF)
    decided = pupil.post("learning/change", {"decision": "ignore", "replay": True})
    assert decided["rows"] == 2 * BATCH
    (said,) = drive(pupil, range(3, 4), push=OFF)
    assert (said["rejected"], said["held"], said["accepted"]) == ({}, False, BATCH)
    assert len(pupil.get("alarms")["items"]) == 1


def test_a_stream_that_fits_goes_on_though_another_one_did_not(school):
    pupil = school.enrol("both", **WATCHFUL, on_change="hold")
    said = drive(pupil, range(4), stream_id="fits")
    assert all(each["accepted"] == BATCH for each in said)
    assert drive(pupil, range(2), push=OFF, stream_id="odd")[-1]["held"]
    pupil.settled(pupil.get("learning")["status"]["revision"])
    states = {each["stream_id"]: each["state"] for each in pupil.get("observations", limit=10)["items"]}
    assert states["fits"] == "learnt"
    pupil.post("learning/change", {"decision": "ignore"})
    assert drive(pupil, range(4, 5), stream_id="fits")[0]["accepted"] == BATCH


def test_another_stream_that_does_not_fit_is_said_so_while_learning_is_held(school):
    """Its errors widen no answers of others, and a decision about the first is no blind one about it."""
    pupil = school.enrol("second", **WATCHFUL, on_change="hold")
    drive(pupil, range(3), push=OFF)
    before = pupil.settled(pupil.get("learning")["status"]["revision"])
    held = pupil.get("learning")["status"]["held"]
    said = drive(pupil, range(4), push=20 * OFF, stream_id="other")
    assert all(each["held"] and each["accepted"] == 0 for each in said)
    newest, first = pupil.get("alarms")["items"]
    assert "stream other does not fit the model: " in newest["message"]
    assert "learning is held already" in newest["message"]
    assert (newest["evidence"]["kind"], newest["evidence"]["stream_id"]) == ("opening", "other")
    assert first["evidence"]["stream_id"] == "arm"
    assert pupil.get("learning")["status"]["held"] == held
    after = pupil.settled(pupil.get("learning")["status"]["revision"])
    assert apart(after, before) < 1e-9
    assert after["scale"] == before["scale"]


def test_where_learning_goes_on_as_before_it_is_only_said(school):
    pupil = school.enrol("told-only", **WATCHFUL, on_change="learn")
    said = drive(pupil, range(3), push=OFF)
    assert not any(each["held"] or "change" in each["rejected"] for each in said)
    assert sum(each["accepted"] for each in said) > 2.5 * BATCH  # a few of its rows are contacts
    (alarm,) = pupil.get("alarms")["items"]
    assert alarm["evidence"]["kind"] == "opening"
    assert "learning goes on as before" in alarm["message"]


def test_a_new_regime_begins_with_the_stream(school):
    pupil = school.enrol("adapts", **WATCHFUL, on_change="adapt")
    said = drive(pupil, range(3), push=OFF)
    assert [each["held"] for each in said] == [False] * 3
    assert "a new regime begins" in pupil.get("alarms")["items"][0]["message"]


def test_how_a_stream_began_is_remembered_over_a_restart(school, tmp_path):
    home = tmp_path / "home"
    with lessons.school(home, school.trained) as first:
        pupil = first.enrol("arm", **WATCHFUL, on_change="hold")
        assert not drive(pupil, range(1), push=OFF)[0]["held"]
        drive(pupil, range(4), stream_id="old")
    with lessons.school(home, school.trained) as second:
        pupil = Pupil(second.client, "arm")
        assert drive(pupil, range(1, 2), push=OFF)[0]["held"]
        pupil.post("learning/change", {"decision": "ignore"})
        (said,) = drive(pupil, range(4, 5), stream_id="old")
        assert said["accepted"] == BATCH
        assert codes(second, pupil)[-BATCH:] == ["learnt"] * BATCH
