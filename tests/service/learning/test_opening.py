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


def make_opening(inside: float, rows: float = OPENING.rows) -> Opening:
    """Return an opening of rows at 10 Hz with this coverage on three joints."""
    count = round(rows)
    return start_opening(np.where(np.arange(count)[:, None] < inside * count, 1.0, 3.0) * np.ones(3))


def start_opening(error):
    """Return an opening of rows at 10 Hz with these errors in standard deviations."""
    count, joints = error.shape
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
    opening = start_opening(np.ones((10, 3)) * [9.0, 1.0, 1.0])
    assert (opening.is_misfit, opening.joints) == (False, (0,))


def send_misfit(learning_model, numbers, external_torque=BIAS_NM, **more):
    """Send batches of a stream of another robot."""
    return send_recording(learning_model, numbers, external_torque=external_torque, **more)


def read_learning(learning_model):
    return learning_model.get("learning")["status"]


def predict_newest(learning_model):
    """Return the prediction of the newest revision."""
    return learning_model.wait_for_revision(read_learning(learning_model)["revision"])


@pytest.fixture
def strict_model(learning_service, learning_model):
    """Model that pauses after a change."""
    return learning_service.create_model(f"{learning_model.name}-strict", **STRICT_OPTIONS, on_change="hold")


def test_misfitting_stream_is_paused_and_its_first_second_unlearnt(learning_service, strict_model):
    """Intervals become wide for this stream alone, until its rows are learnt."""
    before = strict_model.predict()
    replies = send_misfit(strict_model, range(4))
    assert [each["held"] for each in replies] == [False, True, True, True]
    assert [each["rejected"] for each in replies[1:]] == [{"change": BATCH_ROWS}] * 3
    after = predict_newest(strict_model)
    assert max_difference(after, before) < 1e-9
    assert strict_model.get("observations", stream_id="arm")["items"][-1]["state"] == "unlearnt"

    (alarm,) = strict_model.get("alarms")["items"]
    evidence = alarm["evidence"]
    assert alarm["kind"] == "change"
    assert "Stream arm does not fit the model: " in alarm["message"]
    assert "Learning is paused until you decide." in alarm["message"]
    assert (evidence["kind"], evidence["stream_id"], evidence["joints"]) == ("opening", "arm", ["joint1", "joint2"])
    assert evidence["coverage"] == pytest.approx(np.mean(list(evidence["joint_coverage"].values())))
    assert evidence["coverage"] < 0.15
    assert read_learning(strict_model)["held"]["evidence"] == evidence

    assert strict_model.predict()["scale"] == before["scale"]
    scales = learning_service.service.loaded.get(strict_model.name, None).scales
    assert (scales.of("arm") > 2 * scales.of(None)).all()
    strict_model.post("learning/change", {"decision": "ignore"})
    send_misfit(strict_model, range(4, 5))
    assert (np.array(strict_model.predict()["scale"]) > 2 * np.array(before["scale"])).all()


def test_confirmed_stream_is_learnt(strict_model):
    send_misfit(strict_model, range(3))
    assert strict_model.post("learning/change", {"decision": "ignore", "replay": True})["rows"] == 2 * BATCH_ROWS
    (reply,) = send_misfit(strict_model, range(3, 4))
    assert (reply["rejected"], reply["held"], reply["accepted"]) == ({}, False, BATCH_ROWS)
    assert len(strict_model.get("alarms")["items"]) == 1


def test_fitting_stream_is_unaffected_by_a_misfitting_one(strict_model):
    replies = send_recording(strict_model, range(4), stream_id="fits")
    assert all(each["accepted"] == BATCH_ROWS for each in replies)
    assert send_misfit(strict_model, range(2), stream_id="odd")[-1]["held"]
    predict_newest(strict_model)
    states = {each["stream_id"]: each["state"] for each in strict_model.get("observations", limit=10)["items"]}
    assert states["fits"] == "learnt"
    strict_model.post("learning/change", {"decision": "ignore"})
    assert send_recording(strict_model, range(4, 5), stream_id="fits")[0]["accepted"] == BATCH_ROWS


def test_second_misfitting_stream_raises_alarm_while_paused(strict_model):
    """It does not widen intervals of others, and the pause stays that of the first stream."""
    send_misfit(strict_model, range(3))
    before, held = predict_newest(strict_model), read_learning(strict_model)["held"]
    replies = send_misfit(strict_model, range(4), external_torque=20 * BIAS_NM, stream_id="other")
    assert all(each["held"] and each["accepted"] == 0 for each in replies)
    newest, first = strict_model.get("alarms")["items"]
    assert "Stream other does not fit the model: " in newest["message"]
    assert "Learning is already paused" in newest["message"]
    assert (newest["evidence"]["kind"], newest["evidence"]["stream_id"]) == ("opening", "other")
    assert first["evidence"]["stream_id"] == "arm"
    assert read_learning(strict_model)["held"] == held
    after = predict_newest(strict_model)
    assert max_difference(after, before) < 1e-9
    assert after["scale"] == before["scale"]


@pytest.mark.parametrize(
    ("on_change", "message"), [("learn", "Learning continues as before."), ("adapt", "The model adapts")]
)
def test_misfit_raises_alarm_without_pause(learning_service, on_change, message):
    learning_model = learning_service.create_model(f"opening-{on_change}", **STRICT_OPTIONS, on_change=on_change)
    replies = send_misfit(learning_model, range(3))
    assert not any(each["held"] for each in replies)
    (alarm,) = (each for each in learning_model.get("alarms")["items"] if each["kind"] == "change")
    assert alarm["evidence"]["kind"] == "opening"
    assert message in alarm["message"]
    if on_change == "learn":
        assert not any("change" in each["rejected"] for each in replies)
        assert sum(each["accepted"] for each in replies) > 2.5 * BATCH_ROWS  # a few rows are contacts


@pytest.mark.slow
def test_opening_survives_restart(learning_service, tmp_path):
    home = tmp_path / "home"
    with learning_models.start_service(home, learning_service.trained) as first:
        learning_model = first.create_model("arm", **STRICT_OPTIONS, on_change="hold")
        assert not send_misfit(learning_model, range(1))[0]["held"]
        send_recording(learning_model, range(4), stream_id="old")
    with learning_models.start_service(home, learning_service.trained) as second:
        learning_model = LearningModel(second.client, "arm")
        assert send_misfit(learning_model, range(1, 2))[0]["held"]
        learning_model.post("learning/change", {"decision": "ignore"})
        (reply,) = send_recording(learning_model, range(4, 5), stream_id="old")
        assert reply["accepted"] == BATCH_ROWS
        assert read_codes(second, learning_model)[-BATCH_ROWS:] == ["learnt"] * BATCH_ROWS
