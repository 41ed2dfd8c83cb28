"""The opening of a stream: a stream that does not fit the model is reported and not learnt."""

import numpy as np
import pytest
from scipy.stats import binom

from lipcore.online.changes.opening import OPENING, Opening
from tests.service.learning import learning_models
from tests.service.learning.learning_models import LearningModel, max_difference
from tests.service.learning.recordings import read_codes
from tests.service.learning.test_changes import BATCH_ROWS, STRICT_OPTIONS, send_recording

BIAS_NM = 0.05
"""Five times the noise, below a contact."""


def make_opening(inside: float, rows: float = OPENING.rows, joints: int = 3) -> Opening:
    """Return an opening of rows at 10 Hz with this coverage on all joints."""
    count = round(rows)
    error = np.where(np.arange(count)[:, None] < inside * count, 1.0, 3.0) * np.ones(joints)
    return Opening.start(joints).step(np.arange(count) / 10, np.ones(count), error, np.ones((count, joints)))


def test_opening_weights_rows_by_independence():
    rng = np.random.default_rng(3)
    error, spread = rng.standard_normal((250, 2)) * [1.0, 3.0], rng.uniform(0.5, 2.0, (250, 2))
    time, weight = np.arange(250) / 100, np.full(250, 0.1)
    opening = Opening.start(2)
    for rows in np.split(np.arange(250), [30, 31, 95, 140]):
        opening = opening.step(time[rows], weight[rows], error[rows], spread[rows])
    first = slice(0, 100)  # one second
    held = np.abs(error[first]) <= OPENING.band * spread[first]
    assert opening.is_complete
    np.testing.assert_allclose(opening.coverage, held.mean(axis=0))
    assert (opening.rows, opening.since) == (pytest.approx(OPENING.rows), 0.0)
    assert Opening.from_json(opening.to_json()).to_json() == opening.to_json()


def test_misfit_requires_significantly_low_coverage():
    """If coverage is the minimum share, at most one stream in forty has so few rows inside."""
    for hits in range(11):
        chance = binom.cdf(hits, 10, OPENING.min_share)
        assert make_opening(hits / 10).is_misfit == (chance < 0.025)
    assert make_opening(0.0).joints == (0, 1, 2)
    assert not make_opening(0.0, rows=OPENING.rows - 1).is_misfit  # less than one second


def test_single_misfitting_joint_is_no_misfit():
    """One joint of three is left to other detectors: its errors may last for a second."""
    error = np.ones((10, 3)) * [9.0, 1.0, 1.0]
    opening = Opening.start(3).step(np.arange(10) / 10, np.ones(10), error, np.ones((10, 3)))
    assert (opening.is_misfit, opening.joints) == (False, (0,))


@pytest.fixture(scope="module")
def mismatched_model(learning_service):
    """Model with a stream of another robot, its replies, and the prediction before."""
    learning_model = learning_service.create_model("strange", **STRICT_OPTIONS, on_change="hold")
    before = learning_model.predict()
    return learning_model, send_recording(learning_model, range(4), external_torque=BIAS_NM), before


def test_misfitting_stream_is_paused_after_one_second(mismatched_model):
    _, replies, _ = mismatched_model
    assert [each["held"] for each in replies] == [False, True, True, True]
    assert [each["rejected"] for each in replies[1:]] == [{"change": BATCH_ROWS}] * 3


def test_first_second_of_misfitting_stream_is_unlearnt(mismatched_model):
    learning_model, _, before = mismatched_model
    after = learning_model.wait_for_revision(learning_model.get("learning")["status"]["revision"])
    assert max_difference(after, before) < 1e-9
    (first, *_) = learning_model.get("observations", stream_id="arm")["items"][::-1]
    assert first["state"] == "unlearnt"


def test_opening_alarm_contains_the_evidence(mismatched_model):
    learning_model, _, _ = mismatched_model
    (alarm,) = learning_model.get("alarms")["items"]
    evidence = alarm["evidence"]
    assert alarm["kind"] == "change"
    assert "Stream arm does not fit the model: " in alarm["message"]
    assert "Learning is paused until you decide." in alarm["message"]
    assert (evidence["kind"], evidence["stream_id"], evidence["joints"]) == ("opening", "arm", ["joint1", "joint2"])
    assert evidence["coverage"] == pytest.approx(np.mean(list(evidence["joint_coverage"].values())))
    assert evidence["coverage"] < 0.15
    assert learning_model.get("learning")["status"]["held"]["evidence"] == evidence


def test_misfitting_stream_does_not_widen_default_intervals(mismatched_model, learning_service):
    """Only predictions for this stream become wide."""
    learning_model, _, before = mismatched_model
    assert learning_model.predict()["scale"] == before["scale"]
    scales = learning_service.service.loaded.get(learning_model.name, None).scales
    assert (scales.of("arm") > 2 * scales.of(None)).all()
    learning_model.post("learning/change", {"decision": "ignore"})
    send_recording(learning_model, range(4, 5), external_torque=BIAS_NM)
    assert (np.array(learning_model.predict()["scale"]) > 2 * np.array(before["scale"])).all()


def test_confirmed_stream_is_learnt(learning_service):
    learning_model = learning_service.create_model("confirmed", **STRICT_OPTIONS, on_change="hold")
    send_recording(learning_model, range(3), external_torque=BIAS_NM)
    decided = learning_model.post("learning/change", {"decision": "ignore", "replay": True})
    assert decided["rows"] == 2 * BATCH_ROWS
    (reply,) = send_recording(learning_model, range(3, 4), external_torque=BIAS_NM)
    assert (reply["rejected"], reply["held"], reply["accepted"]) == ({}, False, BATCH_ROWS)
    assert len(learning_model.get("alarms")["items"]) == 1


def test_fitting_stream_is_unaffected_by_a_misfitting_one(learning_service):
    learning_model = learning_service.create_model("both", **STRICT_OPTIONS, on_change="hold")
    replies = send_recording(learning_model, range(4), stream_id="fits")
    assert all(each["accepted"] == BATCH_ROWS for each in replies)
    assert send_recording(learning_model, range(2), external_torque=BIAS_NM, stream_id="odd")[-1]["held"]
    learning_model.wait_for_revision(learning_model.get("learning")["status"]["revision"])
    states = {each["stream_id"]: each["state"] for each in learning_model.get("observations", limit=10)["items"]}
    assert states["fits"] == "learnt"
    learning_model.post("learning/change", {"decision": "ignore"})
    assert send_recording(learning_model, range(4, 5), stream_id="fits")[0]["accepted"] == BATCH_ROWS


def test_second_misfitting_stream_raises_alarm_while_paused(learning_service):
    """It does not widen intervals of others, and the pause stays that of the first stream."""
    learning_model = learning_service.create_model("second", **STRICT_OPTIONS, on_change="hold")
    send_recording(learning_model, range(3), external_torque=BIAS_NM)
    before = learning_model.wait_for_revision(learning_model.get("learning")["status"]["revision"])
    held = learning_model.get("learning")["status"]["held"]
    replies = send_recording(learning_model, range(4), external_torque=20 * BIAS_NM, stream_id="other")
    assert all(each["held"] and each["accepted"] == 0 for each in replies)
    newest, first = learning_model.get("alarms")["items"]
    assert "Stream other does not fit the model: " in newest["message"]
    assert "Learning is already paused" in newest["message"]
    assert (newest["evidence"]["kind"], newest["evidence"]["stream_id"]) == ("opening", "other")
    assert first["evidence"]["stream_id"] == "arm"
    assert learning_model.get("learning")["status"]["held"] == held
    after = learning_model.wait_for_revision(learning_model.get("learning")["status"]["revision"])
    assert max_difference(after, before) < 1e-9
    assert after["scale"] == before["scale"]


def test_misfit_only_raises_alarm_with_on_change_learn(learning_service):
    learning_model = learning_service.create_model("told-only", **STRICT_OPTIONS, on_change="learn")
    replies = send_recording(learning_model, range(3), external_torque=BIAS_NM)
    assert not any(each["held"] or "change" in each["rejected"] for each in replies)
    assert sum(each["accepted"] for each in replies) > 2.5 * BATCH_ROWS  # a few rows are contacts
    (alarm,) = learning_model.get("alarms")["items"]
    assert alarm["evidence"]["kind"] == "opening"
    assert "Learning continues as before." in alarm["message"]


def test_misfit_starts_new_regime_with_on_change_adapt(learning_service):
    learning_model = learning_service.create_model("adapts", **STRICT_OPTIONS, on_change="adapt")
    replies = send_recording(learning_model, range(3), external_torque=BIAS_NM)
    assert [each["held"] for each in replies] == [False] * 3
    assert "The model adapts" in learning_model.get("alarms")["items"][0]["message"]


@pytest.mark.slow
def test_opening_survives_restart(learning_service, tmp_path):
    home = tmp_path / "home"
    with learning_models.start_service(home, learning_service.trained) as first:
        learning_model = first.create_model("arm", **STRICT_OPTIONS, on_change="hold")
        assert not send_recording(learning_model, range(1), external_torque=BIAS_NM)[0]["held"]
        send_recording(learning_model, range(4), stream_id="old")
    with learning_models.start_service(home, learning_service.trained) as second:
        learning_model = LearningModel(second.client, "arm")
        assert send_recording(learning_model, range(1, 2), external_torque=BIAS_NM)[0]["held"]
        learning_model.post("learning/change", {"decision": "ignore"})
        (reply,) = send_recording(learning_model, range(4, 5), stream_id="old")
        assert reply["accepted"] == BATCH_ROWS
        assert read_codes(second, learning_model)[-BATCH_ROWS:] == ["learnt"] * BATCH_ROWS
